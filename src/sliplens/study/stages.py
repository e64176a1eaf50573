"""Stages of a study: work on shards whose parts are records, and the result that these make together."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float

from sliplens.codec import load_result, save_result
from sliplens.files import scratch_folder
from sliplens.models import Network
from sliplens.progress import OnProgress, report_progress, reporting
from sliplens.results.explanation import Explanation
from sliplens.runner import MakePart, Part, Work, part, run_parts

Result = TypeVar("Result")
Find: TypeAlias = Callable[[Any, OnProgress], Any]
"""From what a shard is of to its record."""


class Stage(Work, Generic[Result]):
    """Work on the shards of a stage; it travels, so that it holds no more than its shards need."""

    piece: ClassVar[type]
    """Record of a shard."""
    title: ClassVar[str]
    """Description of the work, shown to the user."""

    trained: Network
    """Network that the stage asks."""

    @property
    def on_gpu(self) -> bool:
        """True where the network runs on a graphics card."""
        return self.trained.device.type != "cpu"

    @abstractmethod
    def shards(self) -> Iterator[Part]:
        """All shards, in the order in which `join` takes their records."""

    @abstractmethod
    def prepare(self) -> Find:
        """Make ready what all shards need; once in each process that takes part."""

    @abstractmethod
    def join(self, pieces: Sequence[Any]) -> Result:
        """Make the result of the records of all shards."""

    def begin(self) -> MakePart:
        """Make records, and write each as the folder of its shard."""
        find = self.prepare()

        def make(item: Any, path: Path) -> None:
            piece = find(item, report_progress)
            path.mkdir()
            save_result(piece, path)

        return make

    def make(
        self,
        parts: Path | None = None,
        *,
        work: Work | None = None,
        on_piece: Callable[[Any, Any], None] | None = None,
        on_progress: OnProgress | None = None,
        **how: Any,
    ) -> Result:
        """Make the records that `parts` does not keep yet, and the result.

        `work` opens this stage in other processes; the stage itself does if None. `on_piece` is called with the item of
        each record and the record, as soon as it is there; `how` are other parameters of `run_parts`.
        """
        every = list(self.shards())
        with nullcontext(parts) if parts else scratch_folder() as folder:

            def read(each: Part) -> Any:
                return load_result(folder / each.path, self.piece, command="the interrupted command")

            def show(each: Part) -> None:
                if on_piece is not None:
                    on_piece(each.item, read(each))

            with reporting(on_progress):
                run_parts(work or self, every, folder, title=self.title, on_part=show, **how)
            return self.join([read(each) for each in every])


def mean_of_known(values: Float[np.ndarray, " values"]) -> float | None:
    """Mean of the finite values; None without any, since JSON has no NaN."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def trial_shards(explained: Explanation, *about: str, maps: int = 1) -> Iterator[Part]:
    """A shard of (*about, trial) for each trial of explained frames, of so many maps a frame."""
    for number, (trial, rows) in enumerate(explained.trials.items()):
        # the folder of the parts is one of these explanations and options alone (`files.output_folder`)
        options = {"recipe": about, "content": "", "first": number, "frames": maps * len(rows)}
        yield part((*about, trial), trial=trial, name=" ".join((*about, trial)), **options)


def join_trials(
    explained: Explanation, pieces: Sequence[Mapping[str, np.ndarray]], *, axis: int = 0
) -> dict[str, np.ndarray]:
    """Arrays of all frames, whose axis is named, from those of each trial (`trial_shards`)."""
    order = np.argsort([row for rows in explained.trials.values() for row in rows])
    return {name: np.concatenate([piece[name] for piece in pieces], axis=axis).take(order, axis) for name in pieces[0]}
