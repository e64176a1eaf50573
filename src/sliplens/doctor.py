"""Check of an installation: versions, networks, engines, extras, cameras."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from itertools import islice

import numpy as np
import torch

from sliplens.errors import InputError, SliplensError
from sliplens.files import machine, scratch_folder, shipped_names, versions
from sliplens.live.sources import list_cameras
from sliplens.models.checkpoint import Network, load
from sliplens.models.engines import ENGINES, find_obstacle, prepare
from sliplens.models.onnx import TOLERANCE
from sliplens.progress import OnProgress, number_of, report_each, reporting
from sliplens.recordings.store import load_recording, save_recording
from sliplens.simulation import make_recipe, plan_trials, simulate_trial

_BUILDERS = frozenset({"dev", "docs"})  # extras of those who work on sliplens itself


@dataclass(frozen=True, kw_only=True)
class Item:
    """One part of an installation that was tried."""

    name: str
    works: bool | None
    """None where it is not there, and nothing needs it."""
    detail: str
    """Version or size, or the error and its cure."""


def examine_installation(*, on_progress: OnProgress | None = None) -> tuple[Item, ...]:
    """Try each part of this installation once; what fails is told and does not stop the others.

    Returns
    -------
    tuple[Item, ...]
        Versions, the data store, and each network, engine, extra and camera.
    """
    parts: list[tuple[str, Callable[[], str]]] = [
        ("versions", _versions),
        ("data store", _store),
        ("graphics card", _graphics_card),
        *((f"network {name}", partial(_network, name)) for name in shipped_names()),
        *((f"engine {name}", partial(_engine, name)) for name in ENGINES),
        *((f"extra {name}", partial(_extra, name, needs)) for name, needs in _extras().items()),
        ("cameras", _cameras),
    ]
    with reporting(on_progress):
        return tuple(_try(name, part) for name, part in report_each(parts))


class _AbsentError(SliplensError):
    """Something that is not there, and need not be."""


def _absent(what: str) -> str:
    raise _AbsentError(what)


def _try(name: str, part: Callable[[], str]) -> Item:
    try:
        return Item(name=name, works=True, detail=part())
    # another package may raise anything, and the others are to be tried as well
    except Exception as error:
        message = str(error) if isinstance(error, SliplensError) else f"{type(error).__name__}: {error}"
        works = None if isinstance(error, _AbsentError) else False
        return Item(name=name, works=works, detail=" ".join(message.split())[:300])


def _versions() -> str:
    here = machine()
    packages = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{packages}; {here['system']} {here['processor']}, {here['cores']} cores"


def _store() -> str:
    """Write a simulated trial and read it back."""
    trial = simulate_trial(plan_trials(make_recipe("small", frames_per_trial=20))[0])
    with scratch_folder() as folder:
        save_recording(trial, folder / "trial.parquet")
        size, back = (folder / "trial.parquet").stat().st_size, load_recording(folder / "trial.parquet")
    if not np.array_equal(back.frames, trial.frames):
        raise InputError("frames come back from disk as others; install the pinned versions of pyarrow and numpy")
    return f"{number_of(len(trial), 'frame')} came back to the bit from {size:,} bytes"


def _graphics_card() -> str:
    if not torch.cuda.is_available():
        return _absent("none that torch can use; the CPU does all")
    return f"{torch.cuda.get_device_name()} counts {torch.ones(64, 64, device='cuda').sum().item():.0f}"


def _predict(network: Network) -> tuple[torch.Tensor, torch.Tensor]:
    """Return two encoded images, and their predictions."""
    size, rng = network.manifest.image_size, torch.Generator().manual_seed(0)
    inputs = torch.rand((2, 3, size, size), generator=rng)
    return inputs, network.predict(inputs)


def _network(name: str) -> str:
    network = load(name)
    began = time.perf_counter()
    _, margins = _predict(network)
    milliseconds = 500 * (time.perf_counter() - began)
    if not torch.isfinite(margins).all():
        raise InputError(f"{name} answers with no number; install sliplens again")
    return f"{network.manifest.backbone}, {milliseconds:.0f} ms a frame"


def _engine(name: str) -> str:
    network = load(shipped_names()[0])
    inputs, expected = _predict(network)
    if name == "openvino" and (obstacle := find_obstacle(network.model, inputs)):
        return _absent(obstacle)
    engine = prepare(network.model, inputs, expected, passes=1, engine=name)
    off = max(float((part - whole).abs().max()) for part, whole in zip(engine.run([inputs]), [expected], strict=True))
    if off > TOLERANCE:
        raise InputError(f"its answers differ by {off:.2g}, {TOLERANCE:g} is allowed; leave out --engine {name}")
    return f"agrees with the network to {off:.1g}"


def _extras() -> dict[str, list[str]]:
    """Return the packages of each extra for users."""
    extras: dict[str, list[str]] = {}
    for line in metadata.requires("sliplens") or ():
        parts = re.fullmatch(r"([\w.-]+).*;.*extra == ['\"]([\w-]+)['\"].*", line)
        if parts and parts[2] not in _BUILDERS:
            extras.setdefault(parts[2], []).append(parts[1])
    return extras


def _extra(name: str, needs: list[str]) -> str:
    """Import every package of an extra."""
    texts, modules = [], metadata.packages_distributions()
    for package in needs:
        try:
            texts.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            return _absent(f'{package} is not installed; install with `pip install "sliplens[{name}]"`')
        names = (module for module, names in modules.items() if package in names and not module.startswith("_"))
        for module in islice(names, 1):
            import_module(module)
    return ", ".join(texts)


def _cameras() -> str:
    cameras = list_cameras()
    if not cameras:
        return _absent("none is connected")
    if not any(camera.formats for camera in cameras):
        raise InputError(f"{cameras[0].path} {cameras[0].name}; close what holds it, or join the group video")
    return ", ".join(f"{camera.path} {camera.name} ({number_of(len(camera.formats), 'format')})" for camera in cameras)


__all__ = ["Item", "examine_installation"]
