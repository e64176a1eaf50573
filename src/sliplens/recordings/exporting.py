"""Data sets for other programs: LeRobot data sets and MCAP files, complete or absent."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplens.files import output_folder
from sliplens.progress import OnProgress, number_of, stage, wrote
from sliplens.recordings.dataset import Dataset, load_dataset


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
    """Write trials as a LeRobot v3.0 data set, one episode a trial, without loss; see `write_lerobot`.

    Parameters
    ----------
    data
        Data set, or its folder.
    out
        Folder to make.
    trials
        Names of trials; all if None.

    Raises
    ------
    InputError
        If `out` holds something else, or there is no such trial.
    RecordingError
        If a trial is damaged, or sizes of frames or frame rates differ.
    """
    return _export("lerobot", data, Path(out), trials=trials, overwrite=overwrite, on_progress=on_progress)


def export_mcap(
    data: Dataset | Path | str,
    out: Path | str,
    *,
    trials: Sequence[str] | None = None,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> Export:
    """Write trials as `TRIAL.mcap`, files of ROS 2 messages, without loss; see `write_mcap`.

    Parameters
    ----------
    data, out, trials
        As `export_lerobot` takes them; frames may be of any size and rate.

    Raises
    ------
    InputError
        If `out` holds something else, there is no such trial, or the extra `ros` is not installed.
    RecordingError
        If a trial is damaged, or its times do not fit into stamps of ROS (2**31 seconds).
    """
    return _export("mcap", data, Path(out), trials=trials, overwrite=overwrite, on_progress=on_progress)


def _export(
    name: str,
    data: Dataset | Path | str,
    out: Path,
    *,
    trials: Sequence[str] | None,
    overwrite: bool,
    on_progress: OnProgress | None,
) -> Export:
    # Pillow, PyAV and ROS come with them
    if name == "lerobot":
        from sliplens.recordings.formats.lerobot_export import write_lerobot as write  # noqa: PLC0415

        run_file = "meta/sliplens/run.json"  # it reads `meta` by name
    else:
        from sliplens.recordings.formats.mcap import write_mcap as write  # noqa: PLC0415

        run_file = "run.json"  # tools for MCAP open single files
    data = data if isinstance(data, Dataset) else load_dataset(data)
    chosen = data.trials if not trials else tuple(data.find(name) for name in dict.fromkeys(trials))
    config = {"format": name, "data_hash": data.hash, "trials": [info.trial for info in chosen]}
    with output_folder(
        out, stage="export", config=config, overwrite=overwrite, run_file=run_file, resumable=False
    ) as output:
        if not output.complete:
            with stage(on_progress, "Writing frames") as count:
                write(data, output.folder, trials=chosen, on_progress=count)
    frames = sum(info.frames for info in chosen)
    wrote(on_progress, out, f"{number_of(len(chosen), 'trial')}, {number_of(frames, 'frame')}", kept=output.complete)
    return Export(folder=out, trials=tuple(info.trial for info in chosen), frames=frames)
