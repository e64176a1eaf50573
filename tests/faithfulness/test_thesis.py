"""The thesis's own data: masks to the pixel, scores from predictions, Table 2 from curves."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from sliplens.faithfulness.scoring import delete_pixels, deletion_order, deletion_score
from sliplens.images import read_image

pytestmark = pytest.mark.real

TABLE_2 = {
    ("diff", "gradcam"): (0.3248, 0.1064),
    ("diff", "ig"): (0.2720, 0.1583),
    ("diff", "pcampm"): (0.2001, 0.1458),
    ("raw", "gradcam"): (0.5392, 0.1010),
    ("raw", "ig"): (0.6771, 0.1176),
    ("raw", "pcampm"): (0.5123, 0.2030),
}
BLUR_MEANS = {
    ("diff", "gradcam"): 0.6591,
    ("diff", "ig"): 0.7801,
    ("diff", "pcampm"): 0.2159,
    ("raw", "gradcam"): 0.8560,
    ("raw", "ig"): 0.8459,
    ("raw", "pcampm"): 0.7775,
}


def read_curves(folder: Path, fill: str, kind: str, method: str) -> tuple[list[str], np.ndarray]:
    suffix = "-4" if method == "pcampm" else ""
    with (folder / "scores" / fill / f"del_details_{method}-{kind}-shufflenetv2{suffix}.csv").open() as stream:
        rows = list(csv.reader(stream))[1:]
    return [row[0] for row in rows], np.array([[float(value) for value in row[1:]] for row in rows])


def read_recorded_answers(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "deletion_masks" / "predictions.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_deletion_reproduces_the_recorded_masks_to_the_pixel(chromatouch_folder: Path):
    pixels = read_image(chromatouch_folder / "difference" / "image_547.tiff_0.png")
    saliency = np.load(chromatouch_folder / "poly_cam_saliency.npz")["image_547.tiff"][0, 0]
    image = torch.from_numpy(pixels / pixels.max()).permute(2, 0, 1)
    seen: list[torch.Tensor] = []

    def look(batch: torch.Tensor) -> torch.Tensor:
        seen.extend(batch)
        return batch.mean(dim=(1, 2, 3))

    delete_pixels(look, image[None], deletion_order(saliency)[None], fill="grey")
    for step in (*range(0, 224, 16), 223):
        # the authors' pictures: times 255, cut off to whole levels
        picture = (255 * seen[step]).permute(1, 2, 0).numpy().astype(np.uint8)
        recorded = read_image(chromatouch_folder / "deletion_masks" / f"step_{step:03d}.png")
        np.testing.assert_array_equal(picture, recorded, err_msg=f"step {step}")


def test_equation_2_reproduces_the_recorded_scores_from_the_recorded_answers(chromatouch_folder: Path):
    answers = read_recorded_answers(chromatouch_folder)
    scores = deletion_score(answers["y_base_percent"] / 100, answers["y_mask_percent"] / 100)
    names, recorded = read_curves(chromatouch_folder, "grey", "diff", "pcampm")
    if "image_547.tiff" not in names:
        pytest.skip("image_547 is not among the 42 scored images")
    # answers are rounded to 0.01 %: |dD| <= 2 (1 - |dy|) * 1e-4 <= 2e-4 a step
    np.testing.assert_allclose(scores, recorded[names.index("image_547.tiff")], atol=1e-3)


@pytest.mark.parametrize("cell", TABLE_2)
def test_table_2_follows_from_the_recorded_curves(chromatouch_folder: Path, cell: tuple[str, str]):
    names, curves = read_curves(chromatouch_folder, "grey", *cell)
    assert curves.shape == (42, 224)
    assert len(set(names)) == 42
    auc = curves.mean(axis=1)
    assert (auc.mean(), auc.std()) == pytest.approx(TABLE_2[cell], abs=1e-4)


@pytest.mark.parametrize("cell", BLUR_MEANS)
def test_the_blurred_scores_follow_from_the_recorded_curves(chromatouch_folder: Path, cell: tuple[str, str]):
    _, curves = read_curves(chromatouch_folder, "blur", *cell)
    assert curves.mean() == pytest.approx(BLUR_MEANS[cell], abs=1e-4)
