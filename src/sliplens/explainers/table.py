"""Table of the explainers by name, with the title, colour and line of each in figures; importing it loads no torch."""

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, TypeAlias

from sliplens.errors import InputError
from sliplens.extras import Table

if TYPE_CHECKING:
    from sliplens.explainers.contract import Explainer

Line: TypeAlias = str | tuple[int, tuple[int, ...]]
"""Line style of Matplotlib."""


@dataclass(frozen=True, kw_only=True)
class ExplainerRow:
    """An explainer with its presentation."""

    title: str
    """Name in figures, tables and pages."""
    load: "Callable[[], Explainer]"
    """Function that imports and makes the explainer with its default options; its class, for example."""
    colour: str = "#CC79A7"
    line: Line = "-"


def _method(module: str, name: str, **options: bool | int | str) -> "Callable[[], Explainer]":
    return lambda: getattr(import_module(f"sliplens.explainers.{module}"), name)(**options)


def _by_marker(module: str, name: str) -> "Callable[[], Explainer]":
    def load() -> "Explainer":
        from sliplens.explainers.occlusion import find_markers  # noqa: PLC0415 (loads torch)

        return replace(_method(module, name)(), markers_px=find_markers)  # pyright: ignore[reportArgumentType]

    return load


_ROWS = {
    "grad-cam": ExplainerRow(title="Grad-CAM", load=_method("cam", "GradCam"), colour="#D55E00"),
    "integrated-gradients": ExplainerRow(
        title="Integrated Gradients", load=_method("gradients", "IntegratedGradients"), colour="#56B4E9", line="--"
    ),
    "poly-cam": ExplainerRow(title="Poly-CAM", load=_method("poly_cam", "PolyCam"), colour="#009E73", line="-."),
    "grad-cam-thesis": ExplainerRow(
        title="Grad-CAM as in the thesis",
        load=_method("cam", "GradCam", contrast=False, relu=True),
        colour="#F2A37E",
        line=(0, (5, 1)),
    ),
    "integrated-gradients-thesis": ExplainerRow(
        title="Integrated Gradients as in the thesis",
        load=_method("gradients", "IntegratedGradients", black=True, steps=50, max_steps=50),
        colour="#A9A9A9",
        line=(0, (5, 3)),
    ),
    "poly-cam-thesis": ExplainerRow(
        title="Poly-CAM as in the thesis",
        load=_method("poly_cam", "PolyCam", score="thesis", level=5),
        colour="#E69F00",
        line=(0, (5, 1)),
    ),
    "hires-cam": ExplainerRow(title="HiResCAM", load=_method("cam", "HiResCam")),
    "layer-cam": ExplainerRow(title="LayerCAM", load=_method("cam", "LayerCam")),
    "expected-gradients": ExplainerRow(title="Expected Gradients", load=_method("gradients", "ExpectedGradients")),
    "smooth-grad": ExplainerRow(title="SmoothGrad", load=_method("gradients", "SmoothGrad")),
    "occlusion": ExplainerRow(
        title="Occlusion", load=_method("occlusion", "Occlusion"), colour="#0072B2", line=(0, (3, 1, 1, 1))
    ),
    "occlusion-marker": ExplainerRow(
        title="Occlusion by marker", load=_by_marker("occlusion", "Occlusion"), line=(0, (1, 2))
    ),
    "shapley": ExplainerRow(
        title="Shapley values of tiles", load=_method("shapley", "Shapley"), line=(0, (3, 1, 1, 1, 1, 1))
    ),
    "shapley-marker": ExplainerRow(
        title="Shapley values of markers", load=_by_marker("shapley", "Shapley"), line=(0, (3, 1, 1, 1, 1, 1))
    ),
    "lrp": ExplainerRow(title="LRP", load=_method("lrp", "Lrp"), colour="#6B7280", line=(0, (1, 1))),
}
EXPLAINERS = Table("method", "sliplens.explainers", _ROWS)
"""Explainers by name. `lrp` needs an extra.

Those that end in `-thesis` are the thesis's methods as they were published and run, of f itself. The thesis does not
say whether it ranked the pixels of Integrated Gradients by sign or by size; here their sign counts.

An installed package adds an `ExplainerRow` by the entry point `sliplens.explainers`.
"""
RECOMMENDED_METHOD = "shapley-marker"
"""Default method: its maps rank the markers most like the truth in simulation. Without markers, tiles (`shapley`)."""

Option: TypeAlias = object
"""Value of a field of an explainer."""


def get_explainer(method: str, **options: Option) -> "Explainer":
    """Make the explainer of a row of `EXPLAINERS`, with some of its options (the fields of its class) changed.

    Raises
    ------
    InputError
        If there is no such method, or it has no such option; the message lists those there are.

    Examples
    --------
    >>> from sliplens.explainers.table import get_explainer
    >>> get_explainer("occlusion", tile_px=8).tile_px
    8
    """
    explainer = EXPLAINERS.pick(method).load()
    available = [field.name for field in fields(explainer)] if is_dataclass(explainer) else []
    for name in options:
        if name not in available:
            raise InputError(f"{method} has no option {name!r}; it has {', '.join(available) or 'none'}")
    return replace(explainer, **options) if options else explainer  # pyright: ignore[reportArgumentType]
