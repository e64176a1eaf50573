from dataclasses import replace

import torch

from sliplens.training.data import Augmentation

NOTHING = Augmentation(rotation_deg=0.0, shift=0.0, colour=0.0, noise_sd=0.0, blur_probability=0.0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_no_augmentation_changes_nothing():
    images = torch.rand(4, 3, 16, 16, generator=seeded())
    # bilinear sampling at the pixels' own centres, exact but for the rounding of the grid (a few float32 epsilons)
    torch.testing.assert_close(NOTHING(images, generator=seeded()), images, atol=1e-5, rtol=0)


def test_the_same_state_gives_the_same_images():
    images = torch.rand(4, 3, 16, 16, generator=seeded())
    assert torch.equal(Augmentation()(images, generator=seeded(1)), Augmentation()(images, generator=seeded(1)))
    assert not torch.equal(Augmentation()(images, generator=seeded(1)), Augmentation()(images, generator=seeded(2)))


def test_shifts_move_the_picture_by_no_more_than_the_share():
    images = torch.zeros(64, 1, 32, 32)
    images[..., 16, 16] = 1
    moved = replace(NOTHING, shift=0.1)(images.expand(-1, 3, -1, -1), generator=seeded())[:, 0]
    places = torch.arange(32) - 16.0
    down = (moved.sum(dim=2) * places).sum(dim=1) / moved.sum(dim=(1, 2))
    along = (moved.sum(dim=1) * places).sum(dim=1) / moved.sum(dim=(1, 2))
    # the centre of mass of a bilinearly moved dot is exactly where it moved to
    assert 2.5 < down.abs().max() <= 3.2 + 1e-4
    assert 2.5 < along.abs().max() <= 3.2 + 1e-4
    assert down.mean().abs() < 0.8


def test_colours_change_channel_by_channel_within_bounds():
    images = torch.full((64, 3, 8, 8), 0.5)
    changed = replace(NOTHING, colour=0.1)(images, generator=seeded())
    factors = changed[:, :, 0, 0] / 0.5
    torch.testing.assert_close(changed, (0.5 * factors)[:, :, None, None].expand_as(changed))
    assert 0.9 <= factors.min() < 0.92
    assert 1.08 < factors.max() <= 1.1


def dots(*centres: tuple[float, float]) -> torch.Tensor:
    """Image of smooth dots at offsets (x, y) from the middle, in pixels."""
    places = torch.arange(64) - 31.5
    return torch.stack([torch.exp(-((places - x) ** 2 + (places[:, None] - y) ** 2) / 8) for x, y in centres])


def centre(images: torch.Tensor) -> torch.Tensor:
    places = torch.arange(64) - 31.5
    total = images.sum(dim=(-2, -1))
    return torch.stack(
        [(images.sum(dim=-2) * places).sum(dim=-1) / total, (images.sum(dim=-1) * places).sum(dim=-1) / total], dim=-1
    )


def test_a_magnification_moves_dots_away_from_the_middle_by_no_more_than_its_share():
    images = dots((15.0, 0.0)).expand(256, 3, -1, -1)
    distance = centre(replace(NOTHING, zoom=0.1)(images, generator=seeded())[:, 0]).norm(dim=-1)
    # magnified by 1 / s for s within 1 +- 0.1; a sampled dot's centre of mass is right to a hundredth of a pixel
    assert 15 / 1.1 - 0.01 <= distance.min() < 13.9
    assert 16.4 < distance.max() <= 15 / 0.9 + 0.01


def test_mirroring_keeps_distances_and_swaps_the_order_round_the_middle_in_half_of_the_images():
    first, second = (dots(offset).expand(256, 3, -1, -1) for offset in ((12.0, 0.0), (0.0, 12.0)))
    turned = replace(NOTHING, rotation_deg=180.0, mirror=True)
    # one generator state: both dots are moved alike
    a, b = (centre(turned(images, generator=seeded())[:, 0]) for images in (first, second))
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    torch.testing.assert_close(cross.abs(), torch.full((256,), 144.0), atol=1.5, rtol=0)
    assert 0.4 < (cross < 0).float().mean() < 0.6


def test_frame_and_reference_of_a_pair_are_moved_together():
    images = torch.rand(8, 3, 32, 32, generator=seeded())
    moved = replace(NOTHING, rotation_deg=180.0, mirror=True, zoom=0.03, shift=0.05)(
        torch.cat([images, images], dim=1), generator=seeded()
    )
    torch.testing.assert_close(moved[:, :3], moved[:, 3:])
