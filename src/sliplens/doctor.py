"""Check of an installation: versions, networks, engines, extras, cameras, reference data."""

import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from pathlib import Path

import numpy as np
import torch

from sliplens.errors import InputError, SliplensError
from sliplens.files import machine, scratch_folder, shipped_names, versions
from sliplens.images import list_images, read_image
from sliplens.live.sources import list_cameras
from sliplens.models.checkpoint import Network, load
from sliplens.models.engines import ENGINES, find_obstacle, prepare
from sliplens.models.onnx import TOLERANCE
from sliplens.progress import OnProgress, number_of
from sliplens.recordings.store import load_recording, save_recording
from sliplens.simulation import make_recipe, plan_trials, simulate_trial

_BUILDERS = frozenset({"dev", "docs"})
"""Extras of those who work on sliplens itself."""


@dataclass(frozen=True, kw_only=True)
class Item:
    """One thing that was tried."""

    name: str
    works: bool | None
    """None where it is not there, and nothing needs it."""
    detail: str
    """Version or size, or the error and its cure."""


def examine_installation(*, reference: Path | None = None, on_progress: OnProgress | None = None) -> tuple[Item, ...]:
    """Try each part of this installation once; whatever fails is told, none of it stops the others.

    Parameters
    ----------
    reference
        Folder of the real recordings; that of the environment variable SLIPLENS_REFERENCE, else `../shared/reference`,
        if None.

    Returns
    -------
    tuple[Item, ...]
        Versions, the data store, each network, engine, extra and camera, and each set of reference data.
    """
    tried: list[tuple[str, Callable[[], str | None]]] = [("versions", _versions), ("data store", _store)]
    tried += [("graphics card", _graphics_card)]
    tried += [(f"network {name}", partial(_network, name)) for name in shipped_names()]
    tried += [(f"engine {name}", partial(_engine, name)) for name in ENGINES]
    tried += [(f"extra {name}", partial(_extra, name, needs)) for name, needs in _extras().items()]
    tried += [("cameras", _cameras)]
    folder = reference or Path(os.environ.get("SLIPLENS_REFERENCE", "../shared/reference"))
    there = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    tried += [(f"reference {path.name}", partial(_reference, path)) for path in there]
    tried += [] if there else [("reference data", partial(_absent, f"not at {folder}; set SLIPLENS_REFERENCE"))]
    items = []
    for number, (name, attempt) in enumerate(tried, start=1):
        items.append(_tried(name, attempt))
        if on_progress is not None:
            on_progress(number, len(tried))
    return tuple(items)


class _AbsentError(SliplensError):
    """Something that is not there, and need not be."""


def _absent(what: str) -> str:
    raise _AbsentError(what)


def _tried(name: str, attempt: Callable[[], str | None]) -> Item:
    try:
        return Item(name=name, works=True, detail=attempt() or "")
    except _AbsentError as error:
        return Item(name=name, works=None, detail=str(error))
    # another package may raise anything, and the others are to be tried as well
    except Exception as error:
        message = str(error) if isinstance(error, SliplensError) else f"{type(error).__name__}: {error}"
        return Item(name=name, works=False, detail=" ".join(message.split())[:300])


def _versions() -> str:
    here = machine()
    packages = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{packages}; {here.system} {here.processor}, {here.cores} cores"


def _store() -> str:
    """Write a simulated trial and read it back."""
    (planned, *_) = plan_trials(make_recipe("small", frames_per_trial=20))
    trial = simulate_trial(planned)
    with scratch_folder() as folder:
        save_recording(trial, folder / "trial.parquet")
        size, back = (folder / "trial.parquet").stat().st_size, load_recording(folder / "trial.parquet")
    if not np.array_equal(back.frames, trial.frames):
        raise InputError("frames come back from disk as others; install the pinned versions of pyarrow and numpy")
    return f"{number_of(len(trial), 'frame')} came back to the bit from {size:,} bytes"


def _graphics_card() -> str:
    if not torch.cuda.is_available():
        return _absent("none that torch can use; the CPU does all")
    sums = torch.ones(64, 64, device="cuda").sum().item()
    return f"{torch.cuda.get_device_name()} counts {sums:.0f}"


def _inputs(trained: Network) -> torch.Tensor:
    """Encoded images that any network reads."""
    size = trained.manifest.image_size
    return torch.rand((2, 3, size, size), generator=torch.Generator().manual_seed(0))


def _network(name: str) -> str:
    trained = load(name)
    began = time.perf_counter()
    answers = trained.predict(_inputs(trained))
    milliseconds = 500 * (time.perf_counter() - began)
    if not torch.isfinite(answers).all():
        raise InputError(f"{name} answers with no number; install sliplens again")
    return f"{trained.manifest.backbone}, {milliseconds:.0f} ms a frame"


def _engine(name: str) -> str:
    trained = load(shipped_names()[0])
    inputs = _inputs(trained)
    expected = trained.predict(inputs)
    if name == "openvino" and (obstacle := find_obstacle(trained.model, inputs)):
        return _absent(obstacle)
    engine = prepare(trained.model, inputs, expected, passes=1, engine=name)
    off = max(float((part - whole).abs().max()) for part, whole in zip(engine.run([inputs]), [expected], strict=True))
    if off > TOLERANCE:
        raise InputError(f"its answers differ by {off:.2g}, {TOLERANCE:g} is allowed; leave out --engine {name}")
    return f"agrees with the network to {off:.1g}"


def _extras() -> dict[str, list[str]]:
    """Packages of each extra for users, as they are installed."""
    extras: dict[str, list[str]] = {}
    for line in metadata.requires("sliplens") or ():
        records = re.fullmatch(r"([\w.-]+).*;.*extra == ['\"]([\w-]+)['\"].*", line)
        if records and records[2] not in _BUILDERS:
            extras.setdefault(records[2], []).append(records[1])
    return extras


def _extra(name: str, needs: list[str]) -> str:
    """Import every package of an extra."""
    text, modules = [], metadata.packages_distributions()
    for package in needs:
        try:
            text.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            return _absent(f'{package} is not installed; install with `pip install "sliplens[{name}]"`')
        rows = [module for module, names in modules.items() if package in names and not module.startswith("_")]
        for module in rows[:1]:
            import_module(module)
    return ", ".join(text)


def _cameras() -> str:
    try:
        records = list_cameras()
    except InputError as error:
        return _absent(str(error))
    if not records:
        return _absent("none is connected")
    if not any(camera.modes for camera in records):
        raise InputError(f"{records[0].path} {records[0].name}; close what holds it, or join the group video")
    return ", ".join(f"{camera.path} {camera.name} ({number_of(len(camera.modes), 'mode')})" for camera in records)


def _reference(folder: Path) -> str:
    """Read one image of each folder of images below."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    inside = {path.parent for path in files if path.suffix == ".png"}
    sizes = {read_image(list_images(record)[0]).shape[:2] for record in sorted(inside)}
    read = ", ".join(f"images of {height} x {width} pixels" for height, width in sorted(sizes))
    return "; ".join(filter(None, (number_of(len(files), "file"), read)))


__all__ = ["Item", "examine_installation"]
