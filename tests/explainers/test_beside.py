"""Networks that see the reference beside the frame: the frame is masked, explained and scored, the reference stays."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from quick import QUICK
from torch import Tensor, nn

from sliplens.explainers.gradients import ExpectedGradients
from sliplens.explainers.poly_cam import PolyCam
from sliplens.faithfulness.controls import control_maps

pytestmark = pytest.mark.usefixtures("short_guess")
CHEAP = QUICK | {
    "poly-cam": PolyCam(budget=0.1, likeness=None),
    "poly-cam-thesis": PolyCam(published=True, level=5, budget=0.1, likeness=None),
}


class Beside(nn.Module):
    """A network that reads the frame, and refuses whatever is no reference beside it."""

    def __init__(self, network: nn.Module, reference: Tensor) -> None:
        super().__init__()
        self.network, self.reference = network, reference
        # no part of the pass: what traces it sees the frame's way alone
        self.register_forward_pre_hook(lambda _, inputs: self.require_reference(inputs[0]))

    def require_reference(self, images: Tensor) -> None:
        beside = images[:, 3:]
        assert torch.equal(beside, self.reference.to(beside).expand_as(beside))

    def forward(self, images: Tensor) -> Tensor:
        return self.network(images[:, :3])


@pytest.fixture
def alone(network: Callable[[str], nn.Module]) -> nn.Module:
    return network("small shufflenet").float()


def beside(frames: Tensor, reference: Tensor) -> Tensor:
    return torch.cat([frames, reference.expand_as(frames)], dim=-3)


@pytest.mark.parametrize("name", CHEAP)
def test_a_map_is_that_of_the_frame_and_the_reference_stays(name: str, alone, images, reference):
    explain, frames, empty = CHEAP[name], images[:2].float(), reference.float()
    expected = explain(alone, frames, reference=empty)
    assert bool(expected.relevance.any())
    found = explain(Beside(alone, empty), beside(frames, empty), reference=beside(empty, empty))
    # the same sums, of slices
    torch.testing.assert_close(
        found.relevance, expected.relevance, rtol=1e-4, atol=1e-4 * float(expected.relevance.abs().max())
    )


def test_frames_without_slip_are_shown_beside_the_reference_of_the_image(alone, images, reference):
    frames, background, other = images[:1].float(), images[1:].float(), 1 - reference.float()
    empty = reference.float()
    expected = ExpectedGradients(steps=8, max_steps=40, background=background)(alone, frames)
    explain = ExpectedGradients(steps=8, max_steps=40, background=beside(background, other))
    found = explain(Beside(alone, empty), beside(frames, empty))
    torch.testing.assert_close(found.relevance, expected.relevance, rtol=1e-4, atol=1e-8)
    torch.testing.assert_close(found.reference_prediction, expected.reference_prediction)


def test_controls_are_those_of_the_frame(alone, images, reference):
    frames, empty = images.float(), reference.float().expand(3, -1, -1, -1)
    expected = control_maps(alone, frames, empty)
    found = control_maps(Beside(alone, empty[0]), beside(frames, empty), beside(empty, empty))
    assert found.keys() == expected.keys()
    for name, maps in found.items():
        np.testing.assert_allclose(maps, expected[name], rtol=1e-4, atol=1e-6, err_msg=name)
