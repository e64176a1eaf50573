"""The methods of a study: the thesis's three as they were run, and ours."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

from sliplens.explain import EXPLAINERS, Explainer, Likeness, PolyCam
from sliplens.study.explaining import require_methods

THESIS_POLY_CAM = "poly-cam-thesis"
STUDY_METHODS = ("grad-cam", "integrated-gradients", THESIS_POLY_CAM, "poly-cam", "occlusion")
"""Grad-CAM, Integrated Gradients and Poly-CAM as the thesis ran it; Poly-CAM with the regression score, occlusion."""
STUDY_BUDGET = 0.15
"""Share of the channels that Poly-CAM measures at first: more where the map asks for it."""
_AS_PUBLISHED = Likeness(pearson_r=0.999, top_overlap=0.97)
"""Of the thesis's map, compared with what was published; its weights are nearly all 1, so that this costs little."""


def study_explainers(methods: Sequence[str] = STUDY_METHODS, *, budget: float = STUDY_BUDGET) -> dict[str, Explainer]:
    """Explainers of a study by name.

    Parameters
    ----------
    methods
        Rows of `EXPLAINERS`, or `poly-cam-thesis`: the public code's score, layers, and the map that the thesis scored.
    budget
        Of Poly-CAM, with either score; see `PolyCam`.

    Raises
    ------
    InputError
        If a method is unknown; the message lists those there are.
    """
    table = {
        **EXPLAINERS,
        "poly-cam": PolyCam(budget=budget),
        THESIS_POLY_CAM: PolyCam(score="thesis", level=5, budget=budget, likeness=_AS_PUBLISHED),
    }
    require_methods(methods, table)
    return {name: table[name] for name in methods}


def as_the_thesis_ran(explainers: Mapping[str, Explainer]) -> dict[str, Explainer]:
    """The same, but the thesis's Poly-CAM with all its channels: for what it costs, not for what it shows."""
    return {
        name: replace(one, budget=1.0) if name == THESIS_POLY_CAM and isinstance(one, PolyCam) else one
        for name, one in explainers.items()
    }


def method_options(explainers: Mapping[str, Explainer]) -> dict[str, dict[str, Any]]:
    """Options of each explainer by name: what a map depends on beside the network and the frame."""
    return {
        name: {
            one.name: getattr(explainer, one.name)
            # a row that an installed package added may be any callable
            for one in (fields(explainer) if is_dataclass(explainer) else ())
            # what finds markers is code, not an option
            if not callable(getattr(explainer, one.name))
        }
        for name, explainer in explainers.items()
    }
