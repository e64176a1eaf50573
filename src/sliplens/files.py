"""Files and folders that are whole or absent, and where they come from."""

import hashlib
import json
import os
import platform
import shutil
import stat
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sliplens._version import __version__
from sliplens.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: nothing keeps two commands from one folder there
    fcntl = None

RUN_FILE = "run.json"
"""Provenance of a folder."""
MANIFEST_FILE = "manifest.json"
"""What a network is; its folder is one that holds this."""
_PACKAGES = ("numpy", "torch", "torchvision", "lightning", "captum", "matplotlib", "pyarrow", "pillow")


def versions() -> dict[str, str]:
    """Versions of sliplens, Python and the libraries that shape a result, read without importing them."""
    found = {"sliplens": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A machine, as far as the standard library can tell."""

    system: str
    processor: str
    cores: int | None
    implementation: str
    """Implementation of Python."""


def machine() -> Machine:
    """System, processor and cores of this machine."""
    system, processor, implementation = platform.system(), platform.machine(), sys.implementation.name
    return Machine(system=system, processor=processor, cores=os.cpu_count(), implementation=implementation)


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a folder comes from: what its `run.json` says."""

    stage: str
    config: object
    """All that shaped the result, as JSON holds it: to be shown and compared."""
    config_hash: str
    versions: Mapping[str, str]
    machine: Machine
    finished: str
    """Date and time in UTC, as ISO 8601."""


def to_builtins(value: object) -> Any:
    """What JSON can hold of a record, or of anything made of records, mappings, sequences, paths, texts and numbers.

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
    """SHA-256 (first 16 hex digits) of a value's canonical JSON: the same recipe gives the same hash."""
    text = json.dumps(to_builtins(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_tree(path: Path) -> str:
    """SHA-256 of a file's bytes, or of the names and bytes of all files below a folder."""
    if path.is_file():
        return hash_file(path)
    return hash_json({str(one.relative_to(path)): hash_file(one) for one in path.rglob("*") if one.is_file()})


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, whole or not at all."""
    text = json.dumps(to_builtins(value), indent=2, allow_nan=False) + "\n"
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a file beside the target to write to; it takes the target's name when all went well, else it is gone.

    Raises
    ------
    InputError
        If another process is writing it.
    OSError
        If it cannot be written: no folder of that name can be made, or there is no room.
    """
    part = path.with_name(f".{path.name}.part")

    def make() -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        return part

    try:
        with _held(make, f"another sliplens is writing {path}; wait until it is done, or choose another file"):
            try:
                yield part
                # else a machine that goes down may leave the name of an empty file; the name itself is not waited for:
                # without it the file is absent, which it may be
                with part.open("rb+") as stream:
                    os.fsync(stream)
                part.replace(path)
            except BaseException:
                with suppress(OSError):
                    part.unlink()
                raise
    except OSError as error:
        if error.filename in {None, str(part)}:  # some libraries tell no name, and nobody knows the part's
            raise OSError(error.errno, error.strerror or str(error), str(path)) from None
        raise


MOST_TEXT = 64 * 2**20
"""Bytes of a JSON or TOML file; the table of a hundred thousand trials has 40 million."""
_DEEPEST = 64  # lists and objects in one another; ours are less than ten deep


def require_file(path: Path, *, missing: str = "check the path", most: int | None = None) -> int:
    """Size in bytes of a regular file, no larger than `most`; whoever opens a pipe or a device may wait for ever.

    Raises
    ------
    InputError
        If it does not exist, is a folder, a pipe, a socket or a device, or is larger.
    """
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path} does not exist; {missing}") from None
    except (OSError, ValueError) as error:  # a name that is too long, or holds what no name can
        raise InputError(f"{path} cannot be read ({getattr(error, 'strerror', None) or error}); {missing}") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
        raise InputError(f"{path} is {kind}, not a file; {missing}")
    if most is not None and status.st_size > most:
        raise InputError(f"{path} has {status.st_size:,} bytes, and no such file has more than {most:,}; {missing}")
    return status.st_size


def parse_json(text: bytes | str, *, where: object, cure: str) -> Any:
    """What JSON from a file holds; text that is none, or nothing of ours nests so deep, is an `InputError`."""
    try:
        value = msgspec.json.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # a whole number may have too many digits
        raise InputError(f"{where} is not valid JSON ({error}); {cure}") from None
    level = [value]
    for _ in range(_DEEPEST):
        if any(isinstance(one, int) and abs(one) >= 2**64 for one in level):
            raise InputError(f"{where} holds a whole number of more than 64 bits; {cure}")
        inner = (one.values() if isinstance(one, dict) else one for one in level if isinstance(one, dict | list))
        if not (level := [each for one in inner for each in one]):
            return value
    raise InputError(f"{where} nests more than {_DEEPEST} deep; {cure}")


def read_json(
    path: Path, *, missing: str = "name a folder that a sliplens command wrote", damaged: str = "make the folder again"
) -> Any:
    """Read a JSON file; what is missing or damaged is told with its cure."""
    require_file(path, missing=missing, most=MOST_TEXT)
    return parse_json(path.read_bytes(), where=path, cure=damaged)


def read_toml(path: Path, *, what: str) -> dict[str, Any]:
    """Read a TOML file; what is missing or damaged is told with its cure. `what` says what it holds."""
    require_file(path, missing=f"name a TOML file of {what}", most=MOST_TEXT)
    try:
        # Windows editors put a mark before the text that TOML does not know
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}; mend it there") from None


def require_folder(path: Path, *, what: str) -> Path:
    """Return the path when it is a folder."""
    if not path.exists():
        raise InputError(f"{what} {path} does not exist; check the path")
    if not path.is_dir():
        raise InputError(f"{what} {path} is a file, not a folder; name the folder that holds it")
    return path


# the package is installed as files, never as an archive: its weights are mapped into memory from there
_WEIGHTS = Path(str(files("sliplens"))) / "weights"


def shipped_names() -> list[str]:
    """Names of the networks that come with the package."""
    return sorted(path.parent.name for path in _WEIGHTS.glob(f"*/{MANIFEST_FILE}"))


def find_run(run: Path) -> Path:
    """Folder of a network: the one that is named, else the one of that name that comes with the package."""
    if run.exists():
        return run
    names = shipped_names()
    if str(run) in names:
        return _WEIGHTS / run
    shipped = f", or name {' or '.join(names)}, which comes with sliplens" if names else ""
    raise InputError(f"the run {run} does not exist; check the path{shipped}")


_SCRATCH = "sliplens-scratch-"


def _make_scratch() -> Path:
    return Path(tempfile.mkdtemp(prefix=_SCRATCH))


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Folder for what must lie on disk for a while; it is gone afterwards.

    One whose process was killed is removed by the next that needs one.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{_SCRATCH}*"):
        with suppress(OSError):  # somebody else's
            if (held := hold(left, surely=True)) is not None:
                try:
                    shutil.rmtree(left)
                finally:
                    os.close(held)
    folder, held = make_and_hold(_make_scratch)
    while held is None:  # an empty one may be taken for one that was left, and held by who clears it
        folder, held = make_and_hold(_make_scratch)
    try:
        yield folder
    finally:
        _drop(folder)
        os.close(held)


def require_new_file(path: Path, *, suffix: str | Sequence[str] = (), overwrite: bool = False) -> None:
    """Check that a file can be written under its name, which ends in the suffix or one of them."""
    endings = (suffix,) if isinstance(suffix, str) else tuple(suffix)
    if endings and path.suffix not in endings:
        raise InputError(f"{path} does not end in {' or '.join(endings)}; name the file to write so")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists; choose another file or pass --overwrite")


@dataclass(frozen=True, kw_only=True)
class Output:
    """A folder being written: `folder` lies beside the target until everything is in it."""

    folder: Path
    complete: bool
    """True when the target was already made by the same recipe; then there is nothing to do."""


def partial_folder(target: Path) -> Path:
    """Folder in which `output_folder` makes a target."""
    return target.with_name(f".{target.name}.partial")


def hold(path: Path, *, surely: bool = False) -> int | None:
    """Hold a file or folder against other processes until what is given is closed; None where another one holds it.

    Where there are no locks it is held as well as can be, or, if that is to be sure, not at all.
    """
    descriptor = os.open(path if fcntl else os.devnull, os.O_RDONLY)
    locks = fcntl is not None
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError:  # a file system without locks
        locks = False
    if surely and not locks:
        os.close(descriptor)
        return None
    return descriptor


def make_and_hold(make: Callable[[], Path]) -> tuple[Path, int | None]:
    """Make a file or folder and `hold` it; made again where another process has moved it away meanwhile."""
    while True:
        path = make()
        with suppress(FileNotFoundError):
            held = hold(path)
            if held is None or fcntl is None or os.path.samestat(os.fstat(held), path.stat()):
                return path, held
            os.close(held)


@contextmanager
def output_folder(
    target: Path, *, stage: str, config: Any, overwrite: bool = False, run_file: str = RUN_FILE, resumable: bool = True
) -> Iterator[Output]:
    """Write a folder that is complete or absent.

    The caller writes into a hidden folder beside the target (`.NAME.partial`). On success it gets `run.json` (stage,
    configuration and its hash, versions, machine, time) and takes the target's name. When the caller is interrupted the
    partial folder stays, and the next call with the same configuration finds it again, so that finished pieces need not
    be made twice; a partial folder of another configuration is dropped, one that another process is writing an
    `InputError`. A folder of another format begins empty every time (not `resumable`), and has its `run_file` where
    that format's readers do not look.
    """
    recipe = to_builtins(config)
    config_hash = hash_json({"stage": stage, "config": recipe, "sliplens": __version__})
    partial = partial_folder(target)
    if _aside(target).exists():  # whoever replaced it was killed, before or after the new one took its place
        with held_folder(partial, target):  # or is about to put it there
            if _aside(target).exists():
                shutil.rmtree(_aside(target)) if target.exists() else _aside(target).rename(target)
            with suppress(OSError):  # what was begun stays
                partial.rmdir()
    if _is_made(target, config_hash, run_file=run_file, overwrite=overwrite):
        yield Output(folder=target, complete=True)
        return
    with held_folder(partial, target):
        state = partial / ".recipe"
        if _is_made(target, config_hash, run_file=run_file, overwrite=overwrite):  # by another process since
            _drop(partial)
            yield Output(folder=target, complete=True)
            return
        if not (resumable and state.is_file() and state.read_text() == config_hash):
            _empty(partial)
        if resumable:
            state.write_text(config_hash)
        try:
            yield Output(folder=partial, complete=False)
        except BaseException:
            # what is finished stays for the next try; where nothing is, nothing is left behind
            if not resumable or not any(path.is_file() and path != state for path in partial.rglob("*")):
                _drop(partial)
            raise
        if resumable and not state.exists():
            _drop(partial)
            raise InputError(f"{partial} was removed while {target} was being made; give the command again")
        finished = datetime.now(UTC).isoformat(timespec="seconds")
        provenance = Provenance(
            stage=stage,
            config=recipe,
            config_hash=config_hash,
            versions=versions(),
            machine=machine(),
            finished=finished,
        )
        write_json(partial / run_file, provenance)
        state.unlink(missing_ok=True)
        _take_place(partial, target)


def _is_made(target: Path, config_hash: str, *, run_file: str, overwrite: bool) -> bool:
    """Whether a target is there, of the same recipe; one that may not be replaced is an `InputError`."""
    if not target.exists():
        return False
    if not (target / run_file).is_file() and not (overwrite and target.is_dir() and not any(target.iterdir())):
        raise InputError(f"{target} exists and was not made by sliplens; choose another output folder")
    if overwrite:
        return False
    kept = read_json(target / run_file)
    if not (isinstance(kept, dict) and kept.get("config_hash") == config_hash):
        raise InputError(f"{target} holds a result of other settings; choose another folder or pass --overwrite")
    return True


@contextmanager
def _held(make: Callable[[], Path], taken: str) -> Iterator[Path]:
    """Make a file or folder and keep other processes out of it; where one is in it, that is said."""
    path, held = make_and_hold(make)
    if held is None:
        raise InputError(taken)
    try:
        yield path
    finally:
        os.close(held)


@contextmanager
def held_folder(partial: Path, target: Path) -> Iterator[None]:
    """Make the folder in which a target is made, and keep other processes out of it."""

    def make() -> Path:
        try:
            partial.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            why = error.strerror
            raise InputError(f"cannot write to {target.parent} ({why}); choose another output folder") from None
        return partial

    with _held(make, f"another sliplens is writing {target}; wait until it is done, or choose another folder"):
        yield


def _take_place(partial: Path, target: Path) -> None:
    """Put a folder in the place of the target; one of them is whole at any moment."""
    aside = _aside(target)
    if target.exists():
        target.rename(aside)
    partial.rename(target)
    _drop(aside)


def _aside(target: Path) -> Path:
    return target.with_name(f".{target.name}.replaced")


def _drop(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
