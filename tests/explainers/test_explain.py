"""`explain` of arrays: frames in, a record out, by a method's name or an explainer."""

import numpy as np
import pytest
import torch
from dots import draw_dots, make_grid
from quick import saliency
from small import network_of
from there import there

import sliplens
from sliplens.errors import ImageError, InputError
from sliplens.explainers.cam import GradCam
from sliplens.explainers.occlusion import marker_regions, markers_in_frame
from sliplens.explainers.poly_cam import PolyCam
from sliplens.explainers.table import get_explainer

SIZE = 64
FRAMES = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
UNTOUCHED = np.full((SIZE, SIZE, 3), 7, dtype=np.uint8)


@pytest.fixture
def trained(network):
    return lambda kind: network_of(network("gap").float(), input=kind, image_size=SIZE)


def test_frames_are_compared_with_the_untouched_sensor_and_explained_against_it(trained):
    run = trained("raw")
    explanation = sliplens.explain(run, FRAMES, reference=UNTOUCHED, method="grad-cam")
    inputs, empty = (run.encode(frames, UNTOUCHED) for frames in (FRAMES, UNTOUCHED[None]))
    expected = GradCam()(run.model, inputs, reference=empty[0])
    np.testing.assert_allclose(explanation.relevance["grad-cam"], expected.relevance, atol=1e-6)
    np.testing.assert_allclose(explanation.saliency["grad-cam"], saliency(expected), atol=1e-6)
    np.testing.assert_allclose(explanation.influence("grad-cam"), expected.influence, atol=1e-6)
    assert [frame.reference_prediction for frame in explanation.frames] == pytest.approx(
        [float(run.predict(empty))] * 2
    )
    table = explanation.to_arrow()
    # float32 sums in another order
    change = table["prediction"].to_numpy() - table["reference_prediction"].to_numpy()
    assert change.tolist() == pytest.approx(expected.change.tolist(), rel=1e-5, abs=1e-6)
    gap = explanation.methods["grad-cam"].completeness_gap
    assert gap == pytest.approx(there(expected.completeness_gap).tolist(), abs=1e-6)


def test_difference_images_need_no_reference_and_other_networks_do(trained):
    explanation = sliplens.explain(trained("difference"), FRAMES, method="occlusion")
    assert not explanation.references.any()
    assert explanation.methods["occlusion"].completeness_gap is None  # it promises no sum
    with pytest.raises(InputError, match="a network on raw images needs the untouched sensor; give it as reference"):
        sliplens.explain(trained("raw"), FRAMES, method="grad-cam")


def test_a_method_takes_its_options(trained):
    run = trained("difference")
    assert get_explainer("poly-cam", level=1) == PolyCam(level=1)
    coarse = sliplens.explain(run, FRAMES[:1], method=get_explainer("occlusion", tile_px=SIZE))
    assert len(np.unique(coarse.relevance["occlusion"])) == 1  # one tile is the whole image
    both = sliplens.explain(run, FRAMES[:1], method=["grad-cam", get_explainer("occlusion", tile_px=32)])
    assert list(both.relevance) == list(both.methods) == ["grad-cam", "occlusion"]
    with pytest.raises(InputError, match="grad-cam has no option 'tile_px'; it has published"):
        get_explainer("grad-cam", tile_px=8)
    with pytest.raises(InputError, match="there is no method named 'gradcam'; choose one of grad-cam"):
        sliplens.explain("no such run", FRAMES, method="gradcam")


def test_markers_are_found_in_the_camera_frames(trained):
    """Difference images show none; each frame has its own."""
    pytest.importorskip("cv2", reason="OpenCV, of the extra markers, is not installed")
    grids = [make_grid(columns=4, rows=4, pitch=14.0, at=(10.0 + shift, 10.0)) for shift in (0.0, 3.0, -2.0)]
    untouched, *frames = (draw_dots(grid, size=(SIZE, SIZE), radius=3.0) for grid in grids)
    run = trained("difference")
    explanation = sliplens.explain(run, np.stack(frames), reference=untouched)
    assert explanation.method == "shapley-marker"
    assert not any("tiles" in warning for warning in explanation.methods["shapley-marker"].warnings)
    for relevance, frame in zip(explanation.relevance["shapley-marker"], frames, strict=True):
        regions = marker_regions((SIZE, SIZE), markers_in_frame(frame, image_size=SIZE)).numpy()
        values = [np.unique(relevance[regions == number]) for number in np.unique(regions)]
        assert len(values) == 17
        assert all(len(value) == 1 for value in values)
    with pytest.raises(InputError, match="methods by marker need camera frames"):
        sliplens.explain(run, np.stack(frames), method="shapley-marker")


def test_without_a_method_tiles_explain_where_no_markers_show_and_it_says_why(trained):
    explanation = sliplens.explain(trained("difference"), FRAMES[:1])
    notes = explanation.methods["shapley"]
    assert notes.warnings[0].startswith("tiles, not markers: methods by marker need camera frames")
    [frame] = explanation.frames
    change = frame.prediction - frame.reference_prediction
    assert explanation.relevance["shapley"].sum() == pytest.approx(change, abs=1e-5)


def test_frames_of_another_sensor_or_none_at_all_are_refused(trained):
    with pytest.raises(ImageError, match="frames are 64 x 32 pixels but the network was trained on 64 x 64"):
        sliplens.explain(trained("difference"), FRAMES[:, :, :32])
    with pytest.raises(InputError, match="there is no frame; give one or more"):
        sliplens.explain(trained("difference"), FRAMES[:0])


def test_a_map_that_is_not_finite_is_an_error(trained):
    class Holes(GradCam):
        method = "holes"

        def __call__(self, model, images, *, reference=None):
            attribution = super().__call__(model, images, reference=reference)
            attribution.relevance[:, :2, 0] = torch.nan
            return attribution

    with pytest.raises(sliplens.SliplensError, match=r"the map of frame-0000 by holes holds NaN or infinity in 2 of"):
        sliplens.explain(trained("difference"), FRAMES, method=Holes())
