"""`sliplens grip`."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from sliplens.cli.command import Command, InOrder, Output, SameObject
from sliplens.cli.console import print_table
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK


@dataclass(frozen=True, kw_only=True)
class Grip(Command):
    """Grip, lift and hold a simulated object with the safety margin in the loop, and tell what became of it.

    One episode is closed through pixels: both fingertips are filmed, read by the network, and the force answers. It is
    written as a data set with both fingertips, a clip, and a page with force, margin, slip and map. Of more episodes
    the readings are looked up in the network's measured errors, dozens a second. Interrupted, it goes on.
    """

    output: Output
    """Folder to make; the page is report.html in it."""
    object: Literal["cup", "egg", "berries"] = "cup"
    """What is held."""
    controller: str = "margin"
    """fixed, assumed-friction, margin, proportional, reflex or oracle, or one of an installed package."""
    condition: str = "dry"
    """What happens: dry, wet, drifting, unknown, patch (a wet patch at 2.5 s), jolt, poured or lamp (one goes out)."""
    episodes: int = 1
    """How many, each drawn anew."""
    rendered: bool | None = None
    """Close the loop through pixels; if not given, for a single episode."""
    network: str = DEFAULT_NETWORK
    """Folder of a trained network, or the name of one that comes with sliplens."""
    set: tuple[str, ...] = ()
    """Constants of the controller to change, such as --set target=0.3 down_n_s=2."""
    mass: float | None = None
    """Mass of the object in kilograms; drawn if not given."""
    friction: float | None = None
    """Coefficient of friction at the beginning; drawn if not given."""
    told_friction: Annotated[str | None, tyro.conf.arg(metavar="MU|LOW..HIGH|MU+-SD|each")] = None
    """What a network that tells F_t / F_n is told of it: 0.62, 0.3..0.9, or each for that of each episode."""
    grasps: int = 1
    """How many times each object is gripped, one grasp after another."""
    same_object: SameObject = False
    sequence: InOrder = False
    pull: float | None = None
    """Pull on the object in newtons, for 1.5 s; drawn if not given."""
    wet_patch: float | None = None
    """Friction from 2.5 s on over that before, such as 0.5; none if not given."""
    water: float | None = None
    """Water poured in from 2.5 s on, in kilograms; none if not given."""
    latency: float = 0.02
    """Time from an image to the command that answers it, in seconds."""
    method: str | None = "integrated-gradients"
    """Explainer of the page's maps; none for no maps."""
    seed: int = 0
    """Seed: the same seed gives every controller the same episodes."""

    def run(self) -> None:
        """Run the episodes, and draw the page."""
        from sliplens.cli.report import Report
        from sliplens.grip import run_episodes

        rendered = self.episodes == 1 if self.rendered is None else self.rendered
        script = {
            "mass_kg": self.mass,
            "friction": self.friction,
            "pull_n": self.pull,
            "patch_factor": self.wet_patch,
            "patch_at_s": None if self.wet_patch is None else 2.5,
            "water_kg": self.water,
            "water_at_s": None if self.water is None else 2.5,
        }
        grip = self.call(
            run_episodes,
            rendered=rendered,
            script={name: value for name, value in script.items() if value is not None},
            settings=dict(map(constant, self.set)),
            friction=self.told_friction,
            latency_s=self.latency,
            method=self.method if rendered and self.method != "none" else None,
            out=self.output / "grip",
        )
        table = grip.episodes
        rows = [
            ("dropped", f"{int(table.dropped.sum())} of {len(table)}"),
            ("crushed", f"{int(table.crushed.sum())}"),
            ("slip, in the middle", f"{1e3 * float(sorted(table.slip_m)[len(table) // 2]):.1f} mm"),
            ("mean force", f"{table.mean_force_n.mean():.2f} N"),
            ("over the least that holds", f"{100 * table.force_excess.mean():.0f} %"),
            ("time with a margin under 20 %", f"{table.under_20_s.mean():.2f} s"),
        ]
        print_table(f"{self.controller} on a {self.object}, {self.condition}", ("", ""), rows)
        if self.grasps > 1:
            by_grasp = [table.where(table.grasp == one) for one in range(1, self.grasps + 1)]
            rows = [
                (
                    f"{number}",
                    f"{int(one.dropped.sum())} of {len(one)}",
                    f"{100 * one.force_excess.mean():.0f} %",
                    f"{int((one.known_friction > 0).sum())} of {len(one)}",
                )
                for number, one in enumerate(by_grasp, start=1)
            ]
            columns = ("grasp", "dropped", "over the least that holds", "friction known")
            print_table("Grasp after grasp", columns, rows)
        Report(workspace=self.output).run()


def constant(text: str) -> tuple[str, float]:
    """Name and value of a constant."""
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise InputError(f"{text!r} sets no constant; write --set NAME=NUMBER, such as --set target=0.3") from None
