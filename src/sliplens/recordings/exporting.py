"""Data sets for other programs: LeRobot data sets and MCAP files, complete or absent."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplens.files import output_folder
from sliplens.progress import OnProgress, number_of, open_stage, report_file, reporting
from sliplens.recordings.dataset import Dataset, TrialInfo, load_dataset


@dataclass(frozen=True, kw_only=True)
class Export:
    """Trials that were written for other programs."""

    folder: Path
    trials: tuple[str, ...]
    frames: int


def export_lerobot(
    data: Dataset | Path | str,
    out: Path | str,
    *,
    trials: Sequence[str] | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Export:
    """Write trials as a LeRobot v3.0 data set, one episode a trial, without loss.

    `observation.force` is (F_t, 0, F_n) in newtons, `observation.time_s` has the measured times: LeRobot counts time in
    frames of one rate.

    Parameters
    ----------
    data
        Data set, or its folder.
    out
        Folder to make.
    trials
        Names of trials; all if None.

    References
    ----------
    https://huggingface.co/docs/lerobot/lerobot-dataset-v3
    """
    from sliplens.recordings.formats.lerobot_export import write_lerobot  # noqa: PLC0415 (PyAV comes with it)

    with reporting(on_progress):
        run_file = "meta/sliplens/run.json"
        return _export(write_lerobot, data, Path(out), trials=trials, overwrite=overwrite, run_file=run_file)


def export_mcap(
    data: Dataset | Path | str,
    out: Path | str,
    *,
    trials: Sequence[str] | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Export:
    """Write trials as `TRIAL.mcap`, files of ROS 2 messages, without loss.

    Frames are PNG images in `/tactile/image`, labels are in `/tactile/labels` and forces in `/tactile/wrench`. Stamps
    are the times of the trial, later by the whole seconds `stamp_offset_s` in the metadata where it begins before 1 s.

    Parameters
    ----------
    data
        Data set, or its folder.
    out
        Folder to make.
    trials
        Names of trials; all if None. Their frames may have any size and rate.
    """
    from sliplens.recordings.formats.mcap import write_mcap  # noqa: PLC0415 (ROS messages come with it)

    with reporting(on_progress):
        return _export(write_mcap, data, Path(out), trials=trials, overwrite=overwrite, run_file="run.json")


def _export(
    write: Callable[[Dataset, Sequence[TrialInfo], Path], None],
    data: Dataset | Path | str,
    folder: Path,
    *,
    trials: Sequence[str] | None,
    overwrite: bool,
    run_file: str,
) -> Export:
    data = load_dataset(data)
    chosen = tuple(data.find(trial) for trial in dict.fromkeys(trials)) if trials else data.trials
    names, frames = tuple(info.trial for info in chosen), sum(info.frames for info in chosen)
    config = {"format": write.__name__, "data_hash": data.hash, "trials": list(names)}
    with output_folder(
        folder, stage="export", config=config, overwrite=overwrite, run_file=run_file, resumable=False
    ) as output:
        if not output.complete:
            with open_stage("Writing frames"):
                write(data, chosen, output.folder)
    report_file(folder, f"{number_of(len(chosen), 'trial')}, {number_of(frames, 'frame')}", kept=output.complete)
    return Export(folder=folder, trials=names, frames=frames)
