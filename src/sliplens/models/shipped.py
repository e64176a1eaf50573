"""Networks that come with the package, trained on simulated touch."""

from importlib.resources import files
from pathlib import Path

from sliplens.errors import InputError
from sliplens.models.checkpoints import MANIFEST_FILE, TrainedModel, load_checkpoint


def shipped_names() -> list[str]:
    """Names of the networks that come with the package."""
    return sorted(folder.name for folder in _weights().iterdir() if (folder / MANIFEST_FILE).is_file())


def load(name: str, *, device: str = "cpu") -> TrainedModel:
    """Load a network that comes with the package, by its name.

    Parameters
    ----------
    name
        One of `shipped_names`, such as `chromatouch-difference`.
    device
        Where to put it.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    if name not in shipped_names():
        raise InputError(f"no network named {name!r} comes with sliplens; choose {_choices()}")
    return load_checkpoint(_weights() / name, device=device)


def find_run(run: Path) -> Path:
    """Folder of a network: the one that is named, else the one of that name that comes with the package.

    Raises
    ------
    InputError
        If there is neither.
    """
    if run.exists():
        return run
    if str(run) in shipped_names():
        return _weights() / str(run)
    shipped = f", or name {_choices()}, which comes with sliplens" if shipped_names() else ""
    raise InputError(f"the run {run} does not exist; check the path{shipped}")


def _weights() -> Path:
    # the package is installed as files, never as an archive: its weights are mapped into memory from there
    return Path(str(files("sliplens"))) / "weights"


def _choices() -> str:
    return " or ".join(shipped_names()) or "none"
