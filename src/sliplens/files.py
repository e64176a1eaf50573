"""Folders in formats of others: complete or absent, with our `run.json` where no reader of theirs looks."""

import hashlib
import json
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, is_dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from sliplens._version import __version__
from sliplens.errors import InputError

RUN_FILE = "run.json"
_PACKAGES = ("numpy", "torch", "torchvision", "lightning", "captum", "matplotlib", "pyarrow", "pillow")


def versions() -> dict[str, str]:
    """Versions of sliplens, Python and the libraries that shape a result, read without importing them."""
    found = {"sliplens": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """Processor, cores and system of this machine, as far as the standard library can tell."""
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "implementation": sys.implementation.name,
    }


def to_jsonable(value: Any) -> Any:
    """Turn records, paths and tuples into what JSON can hold; everything else must be JSON already."""
    if is_dataclass(value) and not isinstance(value, type):
        return to_jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def hash_json(value: Any) -> str:
    """SHA-256 (first 16 hex digits) of a value's canonical JSON: the same recipe gives the same hash."""
    text = json.dumps(to_jsonable(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, beside the target first, so that no half-written file is ever seen."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(to_jsonable(value), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises
    ------
    InputError
        If the file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; name a folder that a sliplens command wrote") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path} is not valid JSON ({error}); make the folder again") from None


def require_folder(path: Path, *, what: str) -> Path:
    """Return the path when it is a folder.

    Raises
    ------
    InputError
        If it is missing or is a file.
    """
    if not path.exists():
        raise InputError(f"{what} {path} does not exist; check the path")
    if not path.is_dir():
        raise InputError(f"{what} {path} is a file, not a folder; name the folder that holds it")
    return path


@dataclass(frozen=True, kw_only=True)
class Output:
    """A folder being written: `folder` lies beside the target until everything is in it."""

    target: Path
    folder: Path
    complete: bool
    """True when the target was already made by the same recipe; then there is nothing to do."""


@contextmanager
def output_folder(target: Path, *, stage: str, config: Mapping[str, Any], overwrite: bool = False) -> Iterator[Output]:
    """Write a folder that is complete or absent.

    The caller writes into a hidden folder beside the target (`.NAME.partial`). On success it gets `run.json` (stage,
    configuration and its hash, versions, machine, time) and takes the target's name. When the caller is interrupted the
    partial folder stays, and the next call with the same configuration finds it again, so that finished pieces need not
    be made twice; a partial folder of another configuration is dropped.

    Parameters
    ----------
    target
        Folder to be made.
    stage
        Name of the command, kept in `run.json`.
    config
        All that shapes the result: the recipe that decides whether a partial or complete folder is the same.
    overwrite
        Replace a target made by another recipe, or by the same one.

    Yields
    ------
    Output
        `complete` is True when the target already holds the result of this very configuration.

    Raises
    ------
    InputError
        If the target exists with another configuration, or is not a folder that sliplens made.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sliplens.files import output_folder
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     target = Path(folder) / "greeting"
    ...     with output_folder(target, stage="greet", config={"to": "you"}) as output:
    ...         _ = (output.folder / "hello.txt").write_text("hello")
    ...         before = target.exists()
    ...     before, sorted(path.name for path in target.iterdir())
    (False, ['hello.txt', 'run.json'])
    """
    recipe = to_jsonable(config)
    config_hash = hash_json({"stage": stage, "config": recipe, "sliplens": __version__})
    if target.exists() and not overwrite:
        if not (target / RUN_FILE).is_file():
            raise InputError(f"{target} exists and was not made by sliplens; choose another output folder")
        if read_json(target / RUN_FILE).get("config_hash") != config_hash:
            raise InputError(f"{target} holds a result of other settings; choose another folder or pass --overwrite")
        yield Output(target=target, folder=target, complete=True)
        return
    if target.exists() and not (target / RUN_FILE).is_file() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target} was not made by sliplens and will not be overwritten; choose another output folder")
    partial = target.with_name(f".{target.name}.partial")
    state = partial / ".recipe"
    if partial.exists() and (not state.is_file() or state.read_text() != config_hash):
        shutil.rmtree(partial)
    try:
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {target.parent} ({error.strerror}); choose another output folder") from None
    state.write_text(config_hash)
    try:
        yield Output(target=target, folder=partial, complete=False)
    except BaseException:
        # what is finished stays for the next try; where nothing is, nothing is left behind
        if not any(path != state for path in partial.iterdir()):
            shutil.rmtree(partial)
        raise
    write_json(
        partial / RUN_FILE,
        {
            "stage": stage,
            "config": recipe,
            "config_hash": config_hash,
            "versions": versions(),
            "machine": machine(),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    )
    state.unlink()
    if target.exists():
        shutil.rmtree(target)
    partial.rename(target)


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
