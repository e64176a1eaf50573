"""`explain`: frames in, a record out, with a method by its name and its options."""

import numpy as np
import pytest
import torch
from dots import draw_dots, make_grid

import sliplens
from sliplens.errors import ImageError, InputError
from sliplens.explainers.cam import GradCam
from sliplens.explainers.occlusion import marker_regions, markers_in_frame
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.table import get_explainer
from sliplens.models import Network
from sliplens.models.checkpoint import Manifest

SIZE = 64
FRAMES = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
UNTOUCHED = np.full((SIZE, SIZE, 3), 7, dtype=np.uint8)


@pytest.fixture
def trained(network):
    def with_input(kind: str) -> Network:
        manifest = Manifest(
            backbone="gap", input=kind, image_size=SIZE, frame_size=(SIZE, SIZE), sensor="", data_hash=""
        )
        return Network(model=network("gap").float(), manifest=manifest)

    return with_input


def test_frames_are_compared_with_the_untouched_sensor_and_explained_against_it(trained):
    run = trained("raw")
    explanation = sliplens.explain(run, FRAMES, reference=UNTOUCHED, method="grad-cam")
    inputs, empty = (run.encode(frames, UNTOUCHED) for frames in (FRAMES, UNTOUCHED[None]))
    expected = GradCam()(run.model, inputs, reference=empty[0])
    torch.testing.assert_close(explanation.relevance, expected.relevance)
    torch.testing.assert_close(explanation.images, inputs)
    torch.testing.assert_close(explanation.reference_prediction, run.predict(empty).expand(2))


def test_difference_images_need_no_reference_and_other_networks_do(trained):
    explanation = sliplens.explain(trained("difference"), FRAMES, method="grad-cam")
    torch.testing.assert_close(explanation.images.amax(dim=(1, 2, 3)), torch.ones(2))  # as the thesis scales them
    with pytest.raises(InputError, match="a network on raw images needs the untouched sensor; give it as reference"):
        sliplens.explain(trained("raw"), FRAMES, method="grad-cam")


def test_a_method_takes_its_options(trained):
    run = trained("difference")
    assert get_explainer("poly-cam", variant="+") == PolyCam(variant="+")
    coarse = sliplens.explain(run, FRAMES[:1], method="occlusion", tile_px=SIZE)
    assert len(coarse.relevance.unique()) == 1  # one tile is the whole image
    with pytest.raises(InputError, match="grad-cam has no option 'tile_px'; it has layer, contrast, relu, batch_size"):
        sliplens.explain(run, FRAMES, method="grad-cam", tile_px=8)
    with pytest.raises(InputError, match="there is no method named 'gradcam'; choose one of grad-cam"):
        sliplens.explain(run, FRAMES, method="gradcam")


def test_markers_are_found_in_the_frames_that_the_caller_gave(trained):
    """Difference images show none; each frame has its own."""
    pytest.importorskip("cv2", reason="OpenCV, of the extra markers, is not installed")
    grids = [make_grid(columns=4, rows=4, pitch=14.0, at=(10.0 + shift, 10.0)) for shift in (0.0, 3.0, -2.0)]
    untouched, *frames = (draw_dots(grid, size=(SIZE, SIZE), radius=3.0) for grid in grids)
    run = trained("difference")
    explanation = sliplens.explain(run, np.stack(frames), reference=untouched, pairs=40)
    assert explanation.method == "shapley-marker"
    assert not any("tiles" in warning for warning in explanation.warnings)
    for row, frame in enumerate(frames):
        regions = marker_regions((SIZE, SIZE), markers_in_frame(frame, image_size=SIZE))
        flat = [explanation.relevance[row][regions == number].unique() for number in regions.unique()]
        assert len(flat) == 17
        assert all(len(values) == 1 for values in flat)
    with pytest.raises(InputError, match="markers do not show in difference images"):
        sliplens.explain(run, np.stack(frames), method="shapley-marker")


def test_without_a_method_tiles_explain_where_no_markers_show_and_it_says_why(trained):
    explanation = sliplens.explain(trained("difference"), FRAMES[:1])
    assert explanation.method == "shapley"
    assert explanation.warnings[0].startswith("tiles, not markers: markers do not show in difference images")
    torch.testing.assert_close(explanation.relevance.sum(dim=(1, 2)), explanation.change, atol=1e-5, rtol=0)


def test_frames_of_another_sensor_or_none_at_all_are_refused(trained):
    with pytest.raises(ImageError, match="frames are 64 x 32 pixels but the network was trained on 64 x 64"):
        sliplens.explain(trained("difference"), FRAMES[:, :, :32])
    with pytest.raises(ImageError, match="there is no frame to explain"):
        sliplens.explain(trained("difference"), FRAMES[:0])


def test_the_table_has_a_row_an_image(trained):
    explanation = sliplens.explain(trained("difference"), FRAMES, method="layer-cam")
    table = explanation.frame()
    assert table["change"].to_pylist() == explanation.change.tolist()
    assert np.isnan(table["completeness_gap"].to_numpy()).all()  # LayerCAM promises no sum
