"""The methods of a study, and how the thesis's is timed."""

import pytest
import torch

from sliplens.explainers.explain import with_markers
from sliplens.study.choice import (
    STUDY_METHODS,
    THESIS_POLY_CAM,
    as_the_thesis_ran,
    method_options,
    study_explainers,
    without_markers,
)


@pytest.mark.parametrize("budget", [0.2, 1.0])
def test_the_budget_is_that_of_both_poly_cams(budget: float):
    options = method_options(study_explainers(budget=budget))
    assert {options[name]["budget"] for name in ("poly-cam", THESIS_POLY_CAM)} == {budget}


def test_the_thesis_is_timed_with_all_channels_and_the_others_as_they_are():
    explainers = study_explainers()
    timed = as_the_thesis_ran(explainers)
    assert tuple(timed) == STUDY_METHODS
    before, after = (method_options(table)[THESIS_POLY_CAM] for table in (explainers, timed))
    assert after == before | {"budget": 1.0}
    assert all(timed[name] is explainers[name] for name in STUDY_METHODS if name != THESIS_POLY_CAM)


def test_markers_are_told_by_frame_and_asked_once_where_they_are_needed():
    images, asked = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0)), []

    def find():
        asked.append(1)
        return [torch.full((2, 2), float(row)) for row in range(3)]

    table = with_markers(study_explainers(("shapley-marker", "occlusion-marker", "occlusion")), images, find)
    assert len(asked) == 1
    for row, image in enumerate(images):
        # noise, or one pixel of the next frame, leaves an image what it is
        near = image + 0.05 * torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(1))
        assert all(
            float(vars(table[name])["markers_px"](near, images[0]).mean()) == row
            for name in ("shapley-marker", "occlusion-marker")
        )
    with_markers(study_explainers(("occlusion", "grad-cam")), images, find)
    assert len(asked) == 1


def test_without_markers_tiles_are_asked():
    named = without_markers(study_explainers(("poly-cam", "shapley-marker")))
    assert list(named) == ["poly-cam", "shapley"]
    assert method_options(named)["shapley"]["markers_px"] is None
