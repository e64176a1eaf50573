"""Folders in formats of others: complete or absent, with our `run.json` where no reader of theirs looks."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sliplens._version import __version__
from sliplens.errors import InputError
from sliplens.provenance import Output, hash_json, machine, read_json, to_jsonable, versions, write_json


@contextmanager
def exported_folder(
    target: Path, *, run_file: str, config: Mapping[str, Any], overwrite: bool = False
) -> Iterator[Output]:
    """Write a folder that is complete or absent, as `output_folder` does, but empty at first and never resumed.

    Parameters
    ----------
    target
        Folder to be made.
    run_file
        Where `run.json` goes, below the folder.
    config
        All that shapes the result.
    overwrite
        Replace a folder that an export made.

    Yields
    ------
    Output
        `complete` is True when the target already holds the result of this very configuration.

    Raises
    ------
    InputError
        If the target exists with another configuration, or was not made by an export.
    """
    recipe = to_jsonable(config)
    config_hash = hash_json({"stage": "export", "config": recipe, "sliplens": __version__})
    made = target / run_file
    if target.exists() and not made.is_file():
        raise InputError(f"{target} exists and was not made by this export; choose another output folder")
    if target.exists() and not overwrite:
        if read_json(made).get("config_hash") != config_hash:
            raise InputError(f"{target} holds a result of other settings; choose another folder or pass --overwrite")
        yield Output(target=target, folder=target, complete=True)
        return
    partial = target.with_name(f".{target.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"cannot write to {target.parent} ({error.strerror}); choose another output folder") from None
    try:
        yield Output(target=target, folder=partial, complete=False)
        record = partial / run_file
        record.parent.mkdir(parents=True, exist_ok=True)
        write_json(
            record,
            {
                "stage": "export",
                "config": recipe,
                "config_hash": config_hash,
                "versions": versions(),
                "machine": machine(),
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            },
        )
    except BaseException:
        shutil.rmtree(partial)
        raise
    if target.exists():
        shutil.rmtree(target)
    partial.rename(target)
