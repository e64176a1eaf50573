"""`sliplens predict`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sliplens.cli.command import NETWORK_HELP, SOURCE_HELP, Device, Friction, InOrder, On, RetryFailed, SourceCommand
from sliplens.cli.console import print_table, say, wrote
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK, DIFFERENCE_NETWORK, require_new_file
from sliplens.progress import number_of

if TYPE_CHECKING:
    from sliplens.models.predictions import Predictions, TrialMargins

_RUN = (
    f"{NETWORK_HELP} If left out, the one that the sensor's profile names, else {DEFAULT_NETWORK}, or "
    f"{DIFFERENCE_NETWORK} for difference images."
)
_FEW = 24
"""Frames of which each has a line on the terminal."""
_TRIALS = 40
"""Trials of which each has a line."""
_NO_BAR = "\u00b7"
_BARS = "\u2581\u2582\u2583\u2584\u2585\u2586\u2587\u2588"


@dataclass(frozen=True, kw_only=True)
class Predict(SourceCommand):
    """Read the safety margin of every frame: of a data set, a folder of images, a video, or any recording.

    Shows the margin with its 90 % interval: frame by frame where there are few, else the course of each trial and its
    lowest point. Images of a folder are taken for difference images if no reference is named, which
    networks on differences alone read.
    """

    model: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="[RUN]", help=_RUN)] = None
    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE", help=SOURCE_HELP)] = None
    output: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FILE.csv|FOLDER")] = None
    """Table to write, by its ending .parquet, .csv or .json; without one a folder, a Parquet data set with a file a
    trial: trial, frame, time, margin, interval, and label and forces where they are known. Frames are never all in
    memory at once; the rows of the table are, when they are shown at the end."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None
    """Picture to draw: margin with its interval over time, and label and forces where they are known."""
    engine: Literal["auto", "torch", "openvino"] = "auto"
    """Library that runs the network; auto takes OpenVINO where it is installed and the frames are many."""
    friction: Friction = None
    sequence: InOrder = False
    batch_size: int = 8
    """Frames predicted together; on a CPU more are slower, as they no longer fit its cache."""
    device: Device = "cpu"
    on: On = "serial"
    retry_failed: RetryFailed = False

    def __post_init__(self) -> None:
        if self.source is None:  # one word alone is what to read
            object.__setattr__(self, "source", self.model)
            object.__setattr__(self, "model", None)

    def check(self) -> None:
        """Refuse what is wrong at first sight."""
        from sliplens.codec import TABLE_SUFFIXES
        from sliplens.runner import require_new_table

        if self.source is None:
            raise InputError("name what to read: sliplens predict [RUN] SOURCE")
        if self.output is not None and self.output.suffix:
            require_new_table(self.output, suffix=TABLE_SUFFIXES, overwrite=self.overwrite)
        if self.plot is not None:
            from sliplens.plots.style import require_picture_path

            require_picture_path(self.plot, example="margins.png")
            require_new_file(self.plot, overwrite=self.overwrite)
        if self.batch_size < 1:
            raise InputError(f"--batch-size must be at least 1, got {self.batch_size}")
        super().check()

    def run(self) -> None:
        """Predict, show and write."""
        from sliplens.models.predictions import predict

        assert self.source is not None  # see above
        run, source = (self.source, None) if self.model is None else (self.model, self.source)
        names = ("reference", "reference_frame", "split", "format", "sensor", "on", "retry_failed", "options")
        options = {name: getattr(self, name) for name in names}
        predictions = self.call(predict, run=run, source=source, out=self.output, **options)
        predictions = replace(predictions, rows=predictions.frame())  # a file is read back once
        _show(predictions)
        for reason, frames in predictions.withheld.items():
            say(f"withheld in {number_of(frames, 'frame')}: {reason}")
        if self.friction is not None:
            say(f"margins for a friction of {self.friction}, as you told it")
        if self.plot is not None:
            from sliplens.plots.margins import draw_margins

            read_by = "" if self.model is None else f", read by {self.model.name}"
            shown = draw_margins(predictions.frame(), self.plot, title=f"{self.source.name}{read_by}")
            wrote(self.plot, f"margin over time of {number_of(shown, 'trial')}")
        if self.output is not None:
            wrote(self.output, f"{number_of(predictions.frames, 'frame')}, by {predictions.engine}")


def _show(predictions: "Predictions") -> None:
    if predictions.frames <= _FEW:
        rows = predictions.frame().to_pylist()
        more = {"true": "safety_margin", "known": "known"}
        more = {head: name for head, name in more.items() if any(row.get(name) is not None for row in rows)}
        told = [
            (
                row.get("file") or f"{row['trial']} {row['frame']}",
                _percent(row["prediction"]) if row["withheld"] is None else "withheld",
                _interval(row["low_90"], row["high_90"]),
                *(_percent(row[name]) for name in more.values()),
            )
            for row in rows
        ]
        print_table("Safety margins", ("frame", "safety margin", "90 % interval", *more), told)
        return
    trials = predictions.trials()
    for trial in trials[:_TRIALS]:
        say(_course(trial))
    if len(trials) > _TRIALS:
        say(f"and {number_of(len(trials) - _TRIALS, 'more trial')}; -o margins.csv writes every frame")
    withheld = f", {_NO_BAR} where it is withheld" if predictions.withheld else ""
    say(f"bars: safety margin, 0 % to 100 %, the lowest of the frames that share one{withheld}")


def _course(trial: "TrialMargins") -> str:
    where = f"frame {trial.lowest}" if trial.time_s is None else f"{trial.time_s:.2f} s"
    low, high = trial.interval or (None, None)
    interval = "" if low is None else f" ({_interval(low, high)})"
    touching = "" if trial.touching is None else f", {trial.touching:,} touch" if trial.touching else ", none touches"
    lowest = "none" if trial.lowest is None else f"{_percent(float(trial.margin[trial.lowest]))}{interval} at {where}"
    withheld = f", {trial.withheld:,} withheld" if trial.withheld else ""
    return (
        f"{trial.trial}  {_sparkline(trial.margin.tolist())}  lowest {lowest}, "
        f"{number_of(len(trial.margin), 'frame')}{touching}{withheld}"
    )


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _interval(low: float | None, high: float | None) -> str:
    return "-" if low is None or high is None else f"{100 * low:.0f} to {100 * high:.0f} %"


def _sparkline(shares: Sequence[float], *, width: int = 40) -> str:
    """Draw shares in [0, 1] as bars of a line, the lowest of those that fall into one; NaN has no bar."""
    count = min(width, len(shares))
    parts = (shares[at * len(shares) // count : (at + 1) * len(shares) // count] for at in range(count))
    lowest = (min((share for share in part if not isnan(share)), default=None) for part in parts)
    return "".join(
        _NO_BAR if share is None else _BARS[round(min(max(share, 0.0), 1.0) * (len(_BARS) - 1))] for share in lowest
    )
