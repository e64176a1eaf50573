"""A training as `sliplens train` starts it, in each of its processes."""

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sliplens.errors import RecordingError

if TYPE_CHECKING:
    from lightning.pytorch.loggers import Logger

    from sliplens.models import TrainedModel
    from sliplens.recordings import Dataset, TrialInfo
    from sliplens.training import TrainConfig, TrainProgress
    from sliplens.training.data import FrameSet
    from sliplens.training.fit import TrainResult
    from sliplens.training.hardware import Hardware


@dataclass(frozen=True, kw_only=True)
class TrainingJob:
    """What every process of a training does alike."""

    input: str
    config: "TrainConfig"
    hardware: "Hardware"
    start: "TrainedModel | None"
    data: "Dataset"
    train_trials: tuple["TrialInfo", ...]
    validation_trials: tuple["TrialInfo", ...]

    def load(
        self, *, scratch: Path, on_trial: Callable[[int, int], None] | None = None
    ) -> tuple["FrameSet", "FrameSet"]:
        """Frames to train and to validate on."""
        from sliplens.models.encodings import get_encoding
        from sliplens.training.data import load_frames

        plan = ((self.train_trials, self.config.untouched_share), (self.validation_trials, 0.0))
        total, loaded = sum(len(trials) for trials, _ in plan), []
        for trials, share in plan:
            before = sum(len(trials) for trials, _ in plan[: len(loaded)])
            loaded.append(
                load_frames(
                    self.data,
                    trials,
                    encoding=get_encoding(self.input),
                    image_size=self.config.image_size,
                    untouched_share=share,
                    scratch=scratch,
                    on_trial=None if on_trial is None else partial(_count_on, on_trial, before, total),
                )
            )
        return loaded[0], loaded[1]

    def fit(
        self,
        frames: "FrameSet",
        validation: "FrameSet",
        folder: Path,
        *,
        logger: "Logger | None" = None,
        on_progress: "Callable[[TrainProgress], None] | None" = None,
    ) -> "TrainResult | None":
        """Train and keep the best weights; None in all processes but the first."""
        from sliplens.training import fit

        info = self.train_trials[0]
        return fit(
            self.config,
            frames,
            validation,
            folder,
            frame_size=(info.height, info.width),
            sensor=info.sensor,
            data_hash=self.data.hash,
            trained_on=[one.sha256[:12] for one in (*self.train_trials, *self.validation_trials)],
            start=self.start,
            hardware=self.hardware,
            logger=logger,
            on_progress=on_progress,
        )

    def follow(self, folder: Path) -> None:
        """Help the first process, in silence."""
        # the output folder is the first one's to write, and on a cluster this disk is nearer
        frames, validation = self.load(scratch=Path(tempfile.gettempdir()))
        with suppress(KeyboardInterrupt):  # the first says what there is to say
            self.fit(frames, validation, folder)


def _count_on(on_trial: Callable[[int, int], None], before: int, total: int, done: int, _: int) -> None:
    on_trial(before + done, total)


def choose_trials(data: "Dataset", condition: str | None) -> tuple[tuple["TrialInfo", ...], tuple["TrialInfo", ...]]:
    """Trials to train and to validate on.

    Raises
    ------
    RecordingError
        If there are none, or they are of several sensors.
    """
    try:
        train, validation = (data.select(split=split, condition=condition) for split in ("train", "validation"))
    except RecordingError as error:
        cure = "divide it" if condition is None else "name another --condition, or divide it"
        raise RecordingError(f"{error}; {cure} with `sliplens split`") from None
    sizes = sorted({(info.height, info.width) for info in (*train, *validation)})
    if len(sizes) > 1:
        shown = " and ".join(f"{height} x {width}" for height, width in sizes)
        raise RecordingError(f"{data.folder} mixes frames of {shown} pixels; train on one sensor at a time")
    return train, validation
