"""Files and folders that are whole or absent, on disk or in an object store, and where they come from."""

import errno
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
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from importlib.resources import files
from pathlib import Path, PurePosixPath
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


@lru_cache
def _open_store(bucket: str, endpoint: str | None) -> Any:
    from pyarrow.fs import FileSystem, S3FileSystem  # noqa: PLC0415 (most commands need no store)

    found, _ = FileSystem.from_uri(f"s3://{bucket}")  # which asks for the bucket's region, but tries ten times
    return S3FileSystem(region=found.region, endpoint_override=endpoint)


class StoredPath(type(Path())):
    """Path in an object store, `s3://bucket/key`, which is read as any other is.

    What is written there appears whole: an upload that is not finished is no object. There are no folders without
    files, and no locks. Endpoint and credentials are those of the environment (`AWS_ENDPOINT_URL`,
    `AWS_ACCESS_KEY_ID`, `AWS_PROFILE`, ...).
    """

    _info: Any = None  # what a listing told

    def __str__(self) -> str:
        return f"s3://{self._key}"

    @property
    def _key(self) -> str:
        return "/".join(self.parts[1:])

    @contextmanager
    def _reaching(self) -> Iterator[Any]:
        """Give the file system; what goes wrong is told in one sentence."""
        if not self._key:
            raise InputError("s3:// names no bucket; write s3://BUCKET/NAME")
        bucket = self.parts[1]
        try:
            yield _open_store(bucket, os.environ.get("AWS_ENDPOINT_URL"))
        except FileNotFoundError:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self)) from None
        except OSError as error:
            why = " ".join(str(error).split())
            if "NO_SUCH_BUCKET" in why or "Bucket '" in why:
                raise InputError(f"there is no bucket {bucket} for {self}; check its name, or make it") from None
            if any(word in why for word in ("DENIED", "ACCESS_KEY", "SIGNATURE", "AUTH", "status 403", "credentials")):
                raise InputError(
                    f"the store refuses {self}; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, to "
                    "those of somebody who may use it"
                ) from None
            raise InputError(
                f"{self} cannot be reached ({why[:200]}); check the network, and AWS_ENDPOINT_URL if it is set"
            ) from None

    def _list(self, *, recursive: bool) -> Iterator["StoredPath"]:
        from pyarrow.fs import FileSelector  # noqa: PLC0415

        with self._reaching() as store:
            found = store.get_file_info(FileSelector(self._key, recursive=recursive, allow_not_found=True))
        for info in found:
            path = type(self)("s3:", info.path)
            path._info = info
            yield path

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:  # noqa: ARG002 (there are none)
        """Kind, size and time of an object; a folder is what has files."""
        info = self._info
        if info is None:
            with self._reaching() as store:
                info = store.get_file_info(self._key)
        if info.is_file:
            time_s = int((info.mtime_ns or 0) // 10**9)
            return os.stat_result((stat.S_IFREG, 0, 0, 1, 0, 0, info.size, time_s, time_s, time_s))
        if not any(True for _ in self._list(recursive=False)):  # one that lost its files may be left as a name
            with self._reaching() as store:
                if not store.get_file_info(self.parts[1]).type:
                    raise OSError("NO_SUCH_BUCKET")
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return os.stat_result((stat.S_IFDIR, 0, 0, 1, 0, 0, 0, 0, 0, 0))

    def rglob(self, pattern: str) -> Iterator["StoredPath"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Files below whose path ends as the pattern has it."""
        return (
            path
            for path in self._list(recursive=True)
            if path._info.is_file and PurePosixPath(path._key).match(pattern)
        )

    def glob(self, pattern: str) -> Iterator["StoredPath"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Files below, as deep as the pattern, that match it."""
        depth = len(self.parts) + len(PurePosixPath(pattern).parts)
        return (path for path in self.rglob(pattern) if len(path.parts) == depth)

    def relative_to(self, other: Path, *_: object) -> PurePosixPath:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Path from a folder above."""
        return PurePosixPath(*self.parts).relative_to(PurePosixPath(*other.parts))

    def iterdir(self) -> Iterator["StoredPath"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Files and folders in it."""
        return self._list(recursive=False)

    def mkdir(self, *_: object, **__: object) -> None:
        """Do nothing: a folder is there when a file is in it."""

    def open(self, mode: str = "rb", *_: object) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Open for reading bytes, from anywhere in the file."""
        assert mode == "rb"
        with self._reaching() as store:
            return store.open_input_file(self._key)

    def read_bytes(self) -> bytes:
        """All bytes."""
        with self._reaching(), self.open() as stream:
            return stream.read()

    def read_text(self, encoding: str | None = None, *_: object) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """All text."""
        return self.read_bytes().decode(encoding or "utf-8")

    def write_bytes(self, data: Any) -> int:
        """Write an object, which is there when all of it is."""
        with self._reaching() as store:
            stream = store.open_output_stream(self._key)
            stream.write(data)
            stream.close()  # in no `with`: what failed before this must not be completed
        return len(data)

    def write_text(self, text: str, encoding: str | None = None, *_: object) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Write a text."""
        return self.write_bytes(text.encode(encoding or "utf-8"))

    def upload(self, source: Path, *, last: str = RUN_FILE) -> None:
        """Write a file of this machine, or all files below a folder, the one of a name after all others."""
        import pyarrow as pa  # noqa: PLC0415

        if source.is_dir():
            for path in sorted(source.rglob("*"), key=lambda path: path == source / last):
                if path.is_file():
                    (self / path.relative_to(source)).upload(path)
            return
        with pa.OSFile(str(source)) if not source.stat().st_size else pa.memory_map(str(source)) as stream:
            self.write_bytes(stream.read_buffer())

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove an object."""
        with suppress(FileNotFoundError) if missing_ok else nullcontext(), self._reaching() as store:
            store.delete_file(self._key)

    def are_files(self, paths: Sequence[str]) -> list[bool]:
        """Which of some paths below are files, asked at once."""
        with self._reaching() as store:
            return [info.is_file for info in store.get_file_info([f"{self._key}/{path}" for path in paths])]

    def remove(self) -> None:
        """Remove an object, or all below it."""
        with suppress(FileNotFoundError), self._reaching() as store:
            (store.delete_file if self.is_file() else store.delete_dir)(self._key)


def as_path(path: Path | str) -> Path:
    """Path on disk, or in an object store where it begins with `s3://`."""
    path = Path(path)
    return StoredPath(*path.parts) if path.parts[:1] == ("s3:",) else path


def require_local(target: Path | str) -> None:
    """Refuse a target in a store, for what writes none."""
    if isinstance(stored := as_path(target), StoredPath):
        raise InputError(f"{stored} is in a store, where this writes nothing; name a folder of this machine")


def remove(path: Path) -> None:
    """Remove a file, or a folder with all in it, if it is there; whoever is killed meanwhile leaves no half of it."""
    if isinstance(path, StoredPath):
        path.remove()
        return
    aside = _removed(path)
    _drop(aside)
    if path.is_dir():
        path.rename(aside)
        shutil.rmtree(aside)
    else:
        path.unlink(missing_ok=True)


def end_removal(path: Path) -> None:
    """Remove what is left of a folder whose removal was cut off."""
    _drop_unheld(_removed(path))


def _removed(path: Path) -> Path:
    return path.with_name(f".{path.name}.removed")


def _drop_unheld(folder: Path) -> None:
    """Remove a folder whose process is gone."""
    with suppress(OSError):  # it is not there, or somebody else's
        if (held := hold(folder, surely=True)) is not None:
            try:
                shutil.rmtree(folder)
            finally:
                os.close(held)


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
    if isinstance(path, StoredPath):
        with scratch_folder() as folder:
            (folder / path.name).touch()
            yield folder / path.name
            path.upload(folder / path.name)
        return
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
DEFAULT_NETWORK = "chromatouch-pair"
"""Network of the package that reads where none is named."""
DIFFERENCE_NETWORK = "chromatouch-difference"
"""The same for difference images, which show no frame."""


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
        _drop_unheld(left)
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
    """On this machine."""
    parts: Path
    """Where parts that are whole or absent lie until then: the same, but for a target in a store the target itself."""
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
    if not isinstance(target, StoredPath):
        require_local(target)
    recipe = to_builtins(config)
    config_hash = hash_json({"stage": stage, "config": recipe, "sliplens": __version__})
    if isinstance(target, StoredPath):
        named = {"stage": stage, "recipe": recipe, "config_hash": config_hash}
        with _stored_output(target, **named, overwrite=overwrite, run_file=run_file) as output:
            yield output
        return
    partial = partial_folder(target)
    if _aside(target).exists():  # whoever replaced it was killed, before or after the new one took its place
        with held_folder(partial, target):  # or is about to put it there
            if _aside(target).exists():
                shutil.rmtree(_aside(target)) if target.exists() else _aside(target).rename(target)
            with suppress(OSError):  # what was begun stays
                partial.rmdir()
    if _is_made(target, config_hash, run_file=run_file, overwrite=overwrite):
        yield Output(folder=target, parts=target, complete=True)
        return
    with held_folder(partial, target):
        state = partial / ".recipe"
        if _is_made(target, config_hash, run_file=run_file, overwrite=overwrite):  # by another process since
            _drop(partial)
            yield Output(folder=target, parts=target, complete=True)
            return
        if not (resumable and state.is_file() and state.read_text() == config_hash):
            _empty(partial)
        if resumable:
            state.write_text(config_hash)
        try:
            yield Output(folder=partial, parts=partial, complete=False)
        except BaseException:
            # what is finished stays for the next try; where nothing is, nothing is left behind
            if not resumable or not any(path.is_file() and path != state for path in partial.rglob("*")):
                _drop(partial)
            raise
        if resumable and not state.exists():
            _drop(partial)
            raise InputError(f"{partial} was removed while {target} was being made; give the command again")
        _write_provenance(partial / run_file, stage, recipe, config_hash)
        state.unlink(missing_ok=True)
        _take_place(partial, target)


@contextmanager
def _stored_output(
    target: StoredPath, *, stage: str, recipe: Any, config_hash: str, overwrite: bool, run_file: str
) -> Iterator[Output]:
    """Write a folder in a store, where nothing can be renamed: it is complete when `run.json`, the last, is there."""
    state = target / ".recipe"
    begun = state.is_file() and not (target / run_file).is_file()  # both: it is whole, and only the mark was left
    if not begun and _is_made(target, config_hash, run_file=run_file, overwrite=overwrite):
        yield Output(folder=target, parts=target, complete=True)
        return
    if not (begun and state.read_text() == config_hash):
        state.write_text("")  # of no recipe: whoever comes next clears what is left
        (target / run_file).unlink(missing_ok=True)  # before all others: what is left is nobody's result
        for path in target.rglob("*"):
            if path != state:
                path.unlink(missing_ok=True)
        state.write_text(config_hash)
    with scratch_folder() as folder:
        yield Output(folder=folder, parts=target, complete=False)
        _write_provenance(folder / run_file, stage, recipe, config_hash)
        target.upload(folder, last=run_file)
    state.unlink()


def _write_provenance(path: Path, stage: str, recipe: Any, config_hash: str) -> None:
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    own = {"stage": stage, "config": recipe, "config_hash": config_hash, "finished": finished}
    write_json(path, Provenance(**own, versions=versions(), machine=machine()))


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
