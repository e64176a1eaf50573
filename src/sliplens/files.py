"""Files and folders that are complete or absent, and their provenance."""

import hashlib
import json
import os
import platform
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from filelock import FileLock, Timeout

from sliplens._version import __version__
from sliplens.errors import InputError

RUN_FILE = "run.json"  #: Provenance of a folder.
MANIFEST_FILE = "manifest.json"  #: Facts of a network; its folder is one that holds this.


def remove(path: Path) -> None:
    """Remove a file, or a folder with all in it, if it exists; a folder disappears at once even if killed meanwhile."""
    aside = path.with_name(f".{path.name}.removed")
    shutil.rmtree(aside, ignore_errors=True)
    if path.is_dir():
        path.rename(aside)
        shutil.rmtree(aside)
    else:
        path.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Read the versions of sliplens, Python and the libraries that shape a result, without importing them."""
    versions_by_name = {"sliplens": __version__, "python": platform.python_version()}
    for name in ("numpy", "torch", "torchvision", "lightning", "captum", "matplotlib", "pyarrow", "pillow"):
        with suppress(metadata.PackageNotFoundError):
            versions_by_name[name] = metadata.version(name)
    return versions_by_name


def machine() -> Mapping[str, str | int | None]:
    """Describe this machine: system, processor, cores, and implementation of Python."""
    system, processor, implementation = platform.system(), platform.machine(), sys.implementation.name
    return {"system": system, "processor": processor, "cores": os.cpu_count(), "implementation": implementation}


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a folder: content of its `run.json`."""

    stage: str
    config: object  #: All that shaped the result, as JSON holds it: to be shown and compared.
    config_hash: str
    versions: Mapping[str, str]
    machine: Mapping[str, str | int | None]
    finished: str  #: Date and time in UTC, as ISO 8601.


def to_builtins(value: object) -> Any:
    """Convert a record, or anything made of records, mappings, sequences, paths, texts and numbers, for JSON.

    Arrays have no form in JSON: declare short ones as tuples, long ones as fields of a result (`codec.save_result`).
    """
    return msgspec.to_builtins(value, enc_hook=_encode, str_keys=True)


def _encode(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise NotImplementedError(f"{type(value).__name__} has no form in JSON")


def hash_json(value: Any) -> str:
    """Hash a value's canonical JSON (first 16 hex digits of SHA-256): the same recipe gives the same hash."""
    text = json.dumps(to_builtins(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def hash_file(path: Path) -> str:
    """Hash a file's bytes with SHA-256, as hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_tree(path: Path) -> str:
    """Hash a file's bytes, or the names and bytes of all files below a folder."""
    if path.is_file():
        return hash_file(path)
    return hash_json({str(file.relative_to(path)): hash_file(file) for file in path.rglob("*") if file.is_file()})


def write_json(path: Path, value: Any) -> None:
    """Write a record or another value as indented JSON, whole or not at all; JSON has no NaN."""
    text = json.dumps(to_builtins(value), indent=2, allow_nan=False) + "\n"
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Open a file beside the target for writing; it takes the target's name on success and is removed on failure.

    Raises
    ------
    InputError
        If another process is writing it.
    OSError
        If it cannot be written: its folder cannot be made, or the disk is full.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(part, blocking=False):
            try:
                yield part
                # a machine that goes down later must not leave the name of an empty file
                with part.open("rb+") as stream:
                    os.fsync(stream)
                part.replace(path)
            except BaseException:
                with suppress(OSError):
                    part.unlink()
                raise
    except Timeout:
        raise InputError(f"another sliplens is writing {path}; wait until it is done, or choose another file") from None
    except OSError as error:
        if error.filename in {None, str(part)}:  # the user does not know the name of the part
            raise OSError(error.errno, error.strerror or str(error), str(path)) from None
        raise


MOST_TEXT = 64 * 2**20  #: Bytes of a JSON or TOML file; the table of a hundred thousand trials has 40 million.
_DEEPEST = 64  # lists and objects in one another; ours are less than ten deep


def require_file(
    path: Path, *, missing: str = "check the path", most: int | None = None, error: type[InputError] = InputError
) -> int:
    """Return the size in bytes of a regular file, at most `most`; to open a pipe or a device may wait for ever.

    Raises
    ------
    InputError
        If it does not exist, is a folder, a pipe, a socket or a device, or is larger.
    """
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise error(f"{path} does not exist; {missing}") from None
    except (OSError, ValueError) as raised:  # a name that is too long, or holds what no name can
        raise error(f"{path} cannot be read ({getattr(raised, 'strerror', None) or raised}); {missing}") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
        raise error(f"{path} is {kind}, not a file; {missing}")
    if most is not None and status.st_size > most:
        raise error(f"{path} has {status.st_size:,} bytes, and no such file has more than {most:,}; {missing}")
    return status.st_size


def parse_json(text: bytes | str, *, where: object, cure: str) -> Any:
    """Parse JSON from a file; raise `InputError` for text that is not JSON or nests too deep."""
    try:
        value = msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # a whole number may have too many digits
        raise InputError(f"{where} is not valid JSON ({error}); {cure}") from None
    level = [value]
    for _ in range(_DEEPEST):
        if any(isinstance(item, int) and abs(item) >= 2**64 for item in level):
            raise InputError(f"{where} holds a whole number of more than 64 bits; {cure}")
        inner = (item.values() if isinstance(item, dict) else item for item in level if isinstance(item, dict | list))
        if not (level := [item for items in inner for item in items]):
            return value
    raise InputError(f"{where} nests more than {_DEEPEST} deep; {cure}")


def read_json(
    path: Path, *, missing: str = "name a folder that a sliplens command wrote", damaged: str = "make the folder again"
) -> Any:
    """Read a JSON file; the cures are for a missing and for a damaged one."""
    require_file(path, missing=missing, most=MOST_TEXT)
    return parse_json(path.read_bytes(), where=path, cure=damaged)


def require_folder(path: Path, *, what: str) -> Path:
    """Return the path when it is a folder."""
    if not path.exists():
        raise InputError(f"{what} {path} does not exist; check the path")
    if not path.is_dir():
        raise InputError(f"{what} {path} is a file, not a folder; name the folder that holds it")
    return path


# the package is installed as files, never as an archive: its weights are mapped into memory from there
_WEIGHTS = Path(str(files("sliplens"))) / "weights"
DEFAULT_NETWORK = "chromatouch-pair"  #: Network of the package that predicts where none is named.
DIFFERENCE_NETWORK = "chromatouch-difference"  #: Network of the package for difference images, which show no frame.


def shipped_names() -> list[str]:
    """List the networks that come with the package."""
    return sorted(path.parent.name for path in _WEIGHTS.glob(f"*/{MANIFEST_FILE}"))


def find_run(run: Path) -> Path:
    """Return the folder of a network: the one that is named, else the one of that name that comes with the package."""
    if run.exists():
        return run
    names = shipped_names()
    if str(run) in names:
        return _WEIGHTS / run
    raise InputError(f"the run {run} does not exist; check the path, or name one of sliplens: {', '.join(names)}")


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Open a temporary folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="sliplens-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def require_new_file(path: Path, *, suffix: str | Sequence[str] = (), overwrite: bool = False) -> None:
    """Check that a file can be written under its name, which ends in the suffix or one of them."""
    endings = (suffix,) if isinstance(suffix, str) else tuple(suffix)
    if endings and path.suffix not in endings:
        raise InputError(f"{path} does not end in {' or '.join(endings)}; name the file to write so")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists; choose another file or pass --overwrite")


@dataclass(frozen=True, kw_only=True)
class Output:
    """Folder being written: `folder` lies beside the target until everything is in it."""

    folder: Path
    complete: bool  #: True if the target was made before by the same recipe; then nothing is left to do.


def partial_folder(target: Path) -> Path:
    """Return the folder in which `output_folder` makes a target."""
    return target.with_name(f".{target.name}.partial")


def lock_file(target: Path) -> Path:
    """Return the file that is locked while a target is written; one that a killed process left is not locked."""
    return target.with_name(f".{target.name}.lock")


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Keep other processes from writing a target.

    Raises
    ------
    InputError
        If another process is writing it, or its parent folder cannot be written.
    """
    lock = FileLock(lock_file(target), blocking=False)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise InputError(f"another sliplens is writing {target}; wait, or choose another name") from None
    except OSError as error:
        why = error.strerror
        raise InputError(f"cannot write to {target.parent} ({why}); choose another output folder") from None
    try:
        yield
    finally:
        with suppress(OSError):  # while it is locked: a process that opened the file meanwhile makes it anew
            lock_file(target).unlink()
        lock.release()


def require_new_table(path: Path, *, suffix: str | Sequence[str], overwrite: bool = False) -> None:
    """Check that a table can be written under its name.

    Parts that are older than the table are what a process left that was killed after writing it; they are removed.
    """
    parts = partial_folder(path)
    if path.is_file() and (parts.is_dir() or lock_file(path).exists()):
        with locked(path):
            if not (parts.is_dir() and parts.stat().st_mtime_ns > path.stat().st_mtime_ns):
                remove(parts)
    require_new_file(path, suffix=suffix, overwrite=overwrite)


@contextmanager
def output_folder(
    target: Path, *, stage: str, config: Any, overwrite: bool = False, resumable: bool = True
) -> Iterator[Output]:
    """Write a folder that is complete or absent.

    The caller writes into a hidden folder beside the target (`.NAME.partial`). On success it gets `run.json` (stage,
    configuration and its hash, versions, machine, time) and takes the target's name. After an interruption the partial
    folder remains, and the next call with the same configuration continues in it; a partial folder of another
    configuration is emptied. If not `resumable`, it is always emptied.

    Raises
    ------
    InputError
        If the target exists with other settings and `overwrite` is False, if another process is writing it, or if it
        cannot be written.
    """
    recipe = to_builtins(config)
    config_hash = hash_json({"stage": stage, "config": recipe, "sliplens": __version__})
    partial, replaced = partial_folder(target), target.with_name(f".{target.name}.replaced")
    if not (replaced.exists() or lock_file(target).exists()) and _is_complete(target, config_hash, overwrite=overwrite):
        yield Output(folder=target, complete=True)
        return
    with locked(target):
        if replaced.exists():  # the process that replaced it was killed, before or after the new one took its place
            remove(replaced) if target.exists() else replaced.rename(target)
        if _is_complete(target, config_hash, overwrite=overwrite):
            shutil.rmtree(partial, ignore_errors=True)
            yield Output(folder=target, complete=True)
            return
        recipe_file = partial / ".recipe"
        if not (resumable and recipe_file.is_file() and recipe_file.read_text() == config_hash):
            remove(partial)
        partial.mkdir(exist_ok=True)
        recipe_file.write_text(config_hash)
        try:
            yield Output(folder=partial, complete=False)
        except BaseException:
            if not resumable or not any(path.is_file() and path != recipe_file for path in partial.rglob("*")):
                shutil.rmtree(partial, ignore_errors=True)
            raise
        if not recipe_file.exists():
            shutil.rmtree(partial, ignore_errors=True)
            raise InputError(f"{partial} was removed while {target} was being made; give the command again")
        now, used = datetime.now(UTC).isoformat(timespec="seconds"), versions()
        provenance = Provenance(
            stage=stage, config=recipe, config_hash=config_hash, finished=now, versions=used, machine=machine()
        )
        write_json(partial / RUN_FILE, provenance)
        recipe_file.unlink()
        if target.exists():
            target.rename(replaced)
        partial.rename(target)  # one of the two is complete at any moment
        shutil.rmtree(replaced, ignore_errors=True)


def _is_complete(target: Path, config_hash: str, *, overwrite: bool) -> bool:
    """Return True if a target of the same recipe exists; raise if one exists that may not be replaced."""
    if not target.exists():
        return False
    if not (target / RUN_FILE).is_file() and not (overwrite and target.is_dir() and not any(target.iterdir())):
        raise InputError(f"{target} exists and was not made by sliplens; choose another output folder")
    if overwrite:
        return False
    provenance = read_json(target / RUN_FILE)
    if not (isinstance(provenance, dict) and provenance.get("config_hash") == config_hash):
        raise InputError(f"{target} holds a result of other settings; choose another folder or pass --overwrite")
    return True
