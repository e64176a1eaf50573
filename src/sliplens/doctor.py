"""Check of an installation: versions, networks, engines, extras."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from itertools import islice

import torch

from sliplens.errors import InputError, SliplensError
from sliplens.files import machine, shipped_names, versions
from sliplens.models.checkpoint import Network, load
from sliplens.models.engines import ENGINES, find_obstacle, prepare
from sliplens.models.onnx import TOLERANCE
from sliplens.progress import OnProgress, report_each, reporting

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
    """Try each part of this installation once; one that fails does not stop the others.

    Returns
    -------
    tuple[Item, ...]
        Versions, and each network, engine and extra.

    See Also
    --------
    run_demo : A first result with the included networks.

    Examples
    --------
    >>> import sliplens as sl
    >>> [item.name for item in sl.examine_installation() if not item.works]  # doctest: +SKIP
    ['extra ray']
    """
    parts: list[tuple[str, Callable[[], str]]] = [
        ("versions", _versions),
        *((f"network {name}", partial(_network, name)) for name in shipped_names()),
        *((f"engine {name}", partial(_engine, name)) for name in ENGINES),
        *((f"extra {name}", partial(_extra, name, needs)) for name, needs in _extras().items()),
    ]
    with reporting(on_progress):
        return tuple(_try(name, part) for name, part in report_each(parts))


class _AbsentError(SliplensError):
    """A part that is not installed, and need not be."""


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
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else "no graphics card for torch"
    return f"{packages}; {here['system']} {here['processor']}, {here['cores']} cores, {card}"


def _predict(network: Network) -> tuple[torch.Tensor, torch.Tensor]:
    """Return two encoded images, and their predictions."""
    size, rng = network.manifest.image_size, torch.Generator().manual_seed(0)
    inputs = torch.rand((2, 3, size, size), generator=rng)
    return inputs, network.predict(inputs)


def _network(name: str) -> str:
    network = load(name)
    if not torch.isfinite(_predict(network)[1]).all():
        raise InputError(f"{name} predicts no number; install sliplens again")
    return network.manifest.backbone


def _engine(name: str) -> str:
    network = load(shipped_names()[0])
    inputs, expected = _predict(network)
    if name == "openvino" and (obstacle := find_obstacle(network.model, inputs)):
        raise _AbsentError(obstacle)
    engine = prepare(network.model, inputs, passes=1, engine=name)
    off = max(float((part - whole).abs().max()) for part, whole in zip(engine.run([inputs]), [expected], strict=True))
    if off > TOLERANCE:
        raise InputError(f"its predictions differ by {off:.2g}, {TOLERANCE:g} is allowed; leave out --engine {name}")
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
            cure = f'install with `pip install "sliplens[{name}]"`'
            raise _AbsentError(f"{package} is not installed; {cure}") from None
        names = (module for module, names in modules.items() if package in names and not module.startswith("_"))
        for module in islice(names, 1):
            import_module(module)
    return ", ".join(texts)


__all__ = ["Item", "examine_installation"]
