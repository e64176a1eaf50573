"""Stages of a study: work on parts that are records, and the result that these make together."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float

from sliplens.codec import load_result, save_result
from sliplens.models import Network
from sliplens.progress import report_each
from sliplens.results.explanation import Explanation
from sliplens.runner import MakePart, Part, Work, part, run_parts

Result = TypeVar("Result")
MakeRecord: TypeAlias = Callable[[Any], Any]
"""Function from the item of a part to its record."""


class Stage(Work, Generic[Result]):
    """Work on the parts of a stage; it travels, so that it holds no more than its parts need."""

    record: ClassVar[type]
    """Type of the record of a part."""
    title: ClassVar[str]
    """Description of the work, shown to the user."""

    trained: Network
    """Network that the stage runs."""

    @property
    def on_gpu(self) -> bool:
        """True where the network runs on a graphics card."""
        return self.trained.device.type != "cpu"

    @abstractmethod
    def parts(self) -> Iterator[Part]:
        """Yield all parts, in the order in which `join` takes their records."""

    @abstractmethod
    def prepare(self) -> MakeRecord:
        """Prepare what all parts need, once in each process, and return the function that makes a record."""

    @abstractmethod
    def join(self, records: Sequence[Any]) -> Result:
        """Make the result of the records of all parts."""

    def begin(self) -> MakePart:
        """Return the function that writes the record of a part as a folder."""
        make_record = self.prepare()

        def make(item: Any, path: Path) -> None:
            record = make_record(item)
            path.mkdir()
            save_result(record, path)

        return make

    def make(self, folder: Path | None = None, *, work: Work | None = None, on: str = "serial") -> Result:
        """Make the result, in memory or of the records in a folder, of which those that exist are not made again.

        `work` opens this stage in other processes; the stage itself does if None.
        """
        every = list(self.parts())
        if folder is None:
            make_record = self.prepare()
            sizes = [each.frames for each in every]
            return self.join([make_record(each.item) for each in report_each(every, sizes=sizes)])
        run_parts(work or self, every, folder, on=on)
        command = "the interrupted command"
        return self.join([load_result(folder / each.path, self.record, command=command) for each in every])


@dataclass(frozen=True, kw_only=True)
class TrialArrays:
    """Arrays of the frames of a trial by method, such as maps or predictions."""

    arrays: dict[str, Float[np.ndarray, "frames ..."]]


def mean_of_known(values: Float[np.ndarray, " values"]) -> float | None:
    """Mean of the finite values; None without any, since JSON has no NaN."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def trial_parts(explained: Explanation, *settings: str, maps: int = 1) -> Iterator[Part]:
    """Yield a part of (*settings, trial) for each trial of explained frames, of so many maps a frame."""
    for number, (trial, rows) in enumerate(explained.trials.items()):
        item = (*settings, trial)
        # the folder of the parts is one of these explanations and options alone (`files.output_folder`)
        yield part(
            item, trial=trial, name=" ".join(item), recipe=settings, content="", first=number, frames=maps * len(rows)
        )


def join_trials(explained: Explanation, pieces: Sequence[TrialArrays]) -> dict[str, np.ndarray]:
    """Arrays of all frames, from those of each trial (`trial_parts`)."""
    order = np.argsort([row for rows in explained.trials.values() for row in rows])
    return {name: np.concatenate([piece.arrays[name] for piece in pieces])[order] for name in pieces[0].arrays}
