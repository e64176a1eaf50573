"""`sliplens demo`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sliplens.cli.console import Terminal, say
from sliplens.errors import InputError
from sliplens.progress import number_of


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Have a first look: simulate a few grips, read them, explain what was read, and judge the explanations.

    The page is there within a minute and grows until all of it is made, in some three. It needs no GPU and nothing from
    the internet. Run it again after an interruption and it goes on where it stopped.
    """

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to make; the page is report.html in it."""
    train: bool = False
    """Train networks of your own instead of using those of the package: the whole path, for --max-minutes."""
    max_minutes: float = 10.0
    """With --train: time to aim for, everything included."""
    image_size: int = 96
    """With --train: height and width of the networks' input; the frames are 224 x 224 pixels."""
    real_frames: Path | None = None
    """Folder of real difference images whose names end in the safety margin in percent, as image_433_20.png. If not
    given, the public ChromaTouch images where the environment's SLIPLENS_REFERENCE names the folder that holds them."""
    seed: int | None = None
    """Seed of the simulation and of the random orders."""

    def run(self) -> None:
        """Run every stage, and say where the page is as soon as it is there."""
        from sliplens.demo import DEMO_SEED, run_demo

        if self.max_minutes <= 0:
            raise InputError(f"--max-minutes must be above 0, got {self.max_minutes:g}")
        started = time.perf_counter()
        pages: list[Path] = []

        def on_page(page: Path) -> None:
            if not pages:
                say(f"open {page.resolve()} now: it grows while the rest is made")
            pages.append(page)

        terminal = _WithoutNotes()
        page = run_demo(
            self.output,
            train_minutes=self.max_minutes if self.train else None,
            image_size=self.image_size,
            real_frames=self.real_frames,
            on="processes=2",
            on_page=on_page,
            on_progress=terminal,
            seed=DEMO_SEED if self.seed is None else self.seed,
        )
        if terminal.notes:
            say(f"{number_of(len(terminal.notes), 'note')} on what to be careful with: see the page")
        say(f"the demo took {(time.perf_counter() - started) / 60:.1f} minutes")
        say(f"open {page.resolve()}")


class _WithoutNotes(Terminal):
    """Terminal that keeps notes to itself: a first look has the page to tell them."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []

    def note(self, message: str, /) -> None:
        """Keep a sentence."""
        self.notes.append(message)
