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


@dataclass(frozen=True)
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


_ROWS = {
    "grad-cam": ExplainerRow("Grad-CAM", _method("cam", "GradCam"), "#D55E00"),
    "integrated-gradients": ExplainerRow(
        "Integrated Gradients", _method("gradients", "IntegratedGradients"), "#56B4E9", "--"
    ),
    "poly-cam": ExplainerRow("Poly-CAM", _method("poly_cam", "PolyCam"), "#009E73", "-."),
    "grad-cam-thesis": ExplainerRow(
        "Grad-CAM as in the thesis", _method("cam", "GradCam", published=True), "#F2A37E", (0, (5, 1))
    ),
    "integrated-gradients-thesis": ExplainerRow(
        "Integrated Gradients as in the thesis",
        _method("gradients", "IntegratedGradients", black=True, steps=50, max_steps=50),
        "#A9A9A9",
        (0, (5, 3)),
    ),
    "poly-cam-thesis": ExplainerRow(
        "Poly-CAM as in the thesis", _method("poly_cam", "PolyCam", published=True, level=5), "#E69F00", (0, (5, 1))
    ),
    "expected-gradients": ExplainerRow("Expected Gradients", _method("gradients", "ExpectedGradients")),
    "smooth-grad": ExplainerRow("SmoothGrad", _method("gradients", "SmoothGrad")),
    "occlusion": ExplainerRow("Occlusion", _method("occlusion", "Occlusion"), "#0072B2", (0, (3, 1, 1, 1))),
    "occlusion-marker": ExplainerRow(
        "Occlusion by marker", _method("occlusion", "occlusion_by_marker"), line=(0, (1, 2))
    ),
    "shapley": ExplainerRow("Shapley values of tiles", _method("shapley", "Shapley"), line=(0, (3, 1, 1, 1, 1, 1))),
    "shapley-marker": ExplainerRow(
        "Shapley values of markers", _method("shapley", "shapley_by_marker"), line=(0, (3, 1, 1, 1, 1, 1))
    ),
}
EXPLAINERS = Table("method", "sliplens.explainers", _ROWS)
"""Explainers by name.

Those that end in `-thesis` are the thesis's methods as they were published and run, of f itself. The thesis does not
say whether it ranked the pixels of Integrated Gradients by sign or by size; here their sign counts.

An installed package adds an `ExplainerRow` by the entry point `sliplens.explainers`.
"""
RECOMMENDED_METHOD = "shapley-marker"
"""Default method: its maps rank the markers most like the truth in simulation. Without markers, tiles (`shapley`)."""


def get_explainer(method: str, **options: object) -> "Explainer":
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
    if unknown := options.keys() - available:
        raise InputError(f"{method} has no option {min(unknown)!r}; it has {', '.join(available) or 'none'}")
    return replace(explainer, **options) if options else explainer  # pyright: ignore
