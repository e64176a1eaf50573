"""What removed pixels become."""

import numpy as np
import pytest
import torch

from sliplens.errors import InputError
from sliplens.faithfulness.fills import FILLS, NOISE_SD, get_fill, noisy_linear

ALL = torch.ones(1, 40, 40, dtype=torch.bool)


def filled(name: str, image: torch.Tensor, gone: torch.Tensor, reference: torch.Tensor | None = None) -> torch.Tensor:
    """One image without the pixels that are gone."""
    painter = get_fill(name)(image[None], None if reference is None else reference[None], 0)
    return painter(torch.tensor([0]), gone[None])[0]


@pytest.fixture
def image() -> torch.Tensor:
    return torch.rand(3, 40, 40, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("name", FILLS)
def test_what_is_not_removed_stays(name: str, image: torch.Tensor):
    gone = torch.rand(40, 40, generator=torch.Generator().manual_seed(2)) < 0.5
    painted = filled(name, image, gone, torch.zeros_like(image))
    assert torch.equal(painted[:, ~gone], image[:, ~gone])
    assert painted.min() >= 0
    assert painted.max() <= 1
    assert not torch.equal(painted[:, gone], image[:, gone])


@pytest.mark.parametrize("name", FILLS)
def test_a_batch_is_painted_as_its_images_alone(name: str, image: torch.Tensor):
    generator = torch.Generator().manual_seed(3)
    images, references = torch.stack([image, 1 - image]), torch.rand(2, 3, 40, 40, generator=generator)
    paint = get_fill(name)(images, references, 0)
    gone = torch.rand(4, 40, 40, generator=generator) < 0.5
    for rows in ([0, 1, 1, 0], [1, 1, 1, 1]):
        together = paint(torch.tensor(rows), gone)
        alone = [paint(torch.tensor([row]), one[None])[0] for row, one in zip(rows, gone, strict=True)]
        # the solver of noisy-linear stops once every image of a batch is near enough
        torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=5e-3 if name == "noisy-linear" else 0)


@pytest.mark.parametrize(("name", "level"), [("grey", 0.5), ("black", 0.0), ("white", 1.0)])
def test_constant_fills(name: str, level: float, image: torch.Tensor):
    assert torch.equal(filled(name, image, ALL[0]), torch.full_like(image, level))


def test_the_background_is_the_colour_most_of_the_image_has(image: torch.Tensor):
    colour = torch.tensor([0.1, 0.5, 0.9])[:, None, None]
    mostly = torch.where(torch.arange(40) < 30, colour, image)
    assert torch.equal(filled("background", mostly, ALL[0]), colour.expand(3, 40, 40))


def test_the_reference_is_put_in_place(image: torch.Tensor):
    reference = 1 - image
    assert torch.equal(filled("reference", image, ALL[0], reference), reference)
    with pytest.raises(InputError, match="needs the input of the untouched sensor"):
        filled("reference", image, ALL[0])


def test_blurring_keeps_a_constant_image_and_wipes_out_a_dot():
    constant = torch.full((3, 40, 40), 0.3)
    torch.testing.assert_close(filled("blur", constant, ALL[0]), constant)  # a kernel that sums to 1
    dot = torch.zeros(3, 40, 40)
    dot[:, 20, 20] = 1
    # peak of a Gaussian of 2 pixels: 1 / (2 pi 4), a little more for the cut tails
    assert filled("blur", dot, ALL[0]).max() < 1.1 / (2 * np.pi * 4)


def slow_noisy_linear(image: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """One equation for each removed pixel, solved as a dense system."""
    height, width = gone.shape
    number = {place: index for index, place in enumerate(zip(*np.nonzero(gone), strict=True))}
    matrix, right = np.eye(len(number)), np.zeros((len(number), 3))
    for (row, column), index in number.items():
        around = [
            ((row + down, column + along), 1 / 6 if 0 in (down, along) else 1 / 12)
            for down in (-1, 0, 1)
            for along in (-1, 0, 1)
            if (down, along) != (0, 0) and 0 <= row + down < height and 0 <= column + along < width
        ]
        total = sum(weight for _, weight in around)
        for place, weight in around:
            if place in number:
                matrix[index, number[place]] -= weight / total
            else:
                right[index] += weight / total * image[:, *place]
    solved = np.array(image, dtype=np.float64)
    for place, values in zip(number, np.linalg.solve(matrix, right), strict=True):
        solved[:, *place] = values
    return solved


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_noisy_linear_solves_the_equations_of_its_paper(share: float):
    generator = torch.Generator().manual_seed(3)
    images = torch.rand(4, 3, 12, 15, generator=generator)
    gone = torch.rand(4, 12, 15, generator=generator) < share
    found = noisy_linear(images, gone, tolerance=1e-6)
    for one, hole, image in zip(found, gone, images, strict=True):
        # an error e of the equations moves the solution by at most e times the square of the largest hole: 15^2 * 1e-6
        np.testing.assert_allclose(one.numpy(), slow_noisy_linear(image.numpy(), hole.numpy()), atol=3e-4)


def test_noisy_linear_continues_a_slope_and_adds_its_noise():
    slope = (torch.arange(40.0) / 40).expand(3, 40, 40)
    gone = torch.zeros(40, 40, dtype=torch.bool)
    gone[10:20, 10:20] = True
    smooth = noisy_linear(slope[None], gone[None], tolerance=1e-6)[0]
    torch.testing.assert_close(smooth, slope, rtol=0, atol=1e-4)  # a plane is the mean of its neighbours
    noise = torch.randn(1, 3, 40, 40, generator=torch.Generator().manual_seed(4))
    rough = noisy_linear(slope[None], gone[None], noise=noise, tolerance=1e-6)[0]
    torch.testing.assert_close(rough - smooth, NOISE_SD * noise[0] * gone, rtol=0, atol=1e-6)


def test_an_image_of_which_nothing_is_left_becomes_its_mean(image: torch.Tensor):
    mean = image.mean(dim=(1, 2), keepdim=True).expand_as(image)
    torch.testing.assert_close(noisy_linear(image[None], ALL)[0], mean)
    # and does not disturb another of the same batch
    some = torch.zeros(40, 40, dtype=torch.bool)
    some[5, 5] = True
    both = noisy_linear(torch.stack([image, image]), torch.stack([ALL[0], some]))
    torch.testing.assert_close(both[1], noisy_linear(image[None], some[None])[0])
