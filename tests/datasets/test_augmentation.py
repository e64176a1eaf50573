import torch

from sliplens.datasets import Augmentation

NOTHING = Augmentation(rotation_deg=0.0, noise_sd=0.0, blur_probability=0.0)


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


def test_every_image_is_turned_by_an_angle_of_its_own():
    images = torch.rand(1, 3, 32, 32, generator=seeded()).expand(4, -1, -1, -1)
    turned = Augmentation(rotation_deg=10.0, noise_sd=0.0, blur_probability=0.0)(images, generator=seeded())
    assert not torch.allclose(turned[0], turned[1], atol=1e-3)


def test_augmented_images_stay_in_range():
    images = torch.rand(4, 3, 16, 16, generator=seeded()).round()
    out = Augmentation(noise_sd=0.5, blur_probability=1.0)(images, generator=seeded())
    assert out.min() >= 0
    assert out.max() <= 1
