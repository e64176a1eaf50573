"""The methods of a study, and how the thesis's is timed."""

import torch

from sliplens.explainers.explain import with_markers
from sliplens.study.choice import (
    study_explainers,
    without_markers,
)


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
    assert vars(named["shapley"])["markers_px"] is None
