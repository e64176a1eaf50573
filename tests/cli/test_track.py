import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import typed
from data_sets import save_dataset
from dots import draw_dots, make_grid
from own_recording import write_images

from sliplens.images import write_png
from sliplens.markers import track_markers
from sliplens.markers.tracking import track

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")


@pytest.fixture
def moving(rng):
    """A reference and four frames in which a printed grid moves by 0.5 px each."""
    places = make_grid(jitter=0.5, rng=rng)
    return draw_dots(places), [draw_dots(places + np.array([0.5 * step, 0.0])) for step in range(1, 5)]


@pytest.fixture
def folder(tmp_path, moving):
    write_png(tmp_path / "untouched.png", moving[0])
    return write_images(tmp_path / "frames", moving[1])


def test_a_folder_of_images_becomes_a_table_of_displacements(folder, tmp_path):
    output = tmp_path / "tracks.parquet"
    typed("track", folder, "-o", output, "--reference", tmp_path / "untouched.png")
    table = pq.read_table(output)
    assert table.num_rows == 4 * 30
    assert set(table["status"].to_pylist()) == {"followed"}
    for frame in range(4):
        rows = np.array(table["frame"]) == frame
        np.testing.assert_allclose(np.array(table["dx_px"])[rows], 0.5 * (frame + 1), atol=0.15)
        np.testing.assert_allclose(np.array(table["dy_px"])[rows], 0.0, atol=0.15)
    assert table["time_s"].null_count == table.num_rows
    assert table.schema.metadata[b"sliplens.markers"] == b"auto"


def test_without_a_reference_the_first_frame_stands_for_it_and_says_so(folder, tmp_path, capsys):
    output = tmp_path / "tracks.parquet"
    typed("track", folder, "-o", output)
    table = pq.read_table(output)
    first = np.array(table["frame"]) == 0
    np.testing.assert_allclose(np.array(table["dx_px"])[first], 0.0, atol=1e-5)
    assert "displacements count from the first frame" in capsys.readouterr().err


def test_a_folder_of_parts_holds_the_same_rows_wherever_they_were_made(folder, tmp_path, elsewhere):
    reference = tmp_path / "untouched.png"
    whole = track(folder, reference=reference, out=tmp_path / "a.parquet")
    parts = track(folder, reference=reference, out=tmp_path / "set", on=elsewhere)
    assert parts.to_arrow().to_pylist() == whole.to_arrow().to_pylist()
    assert [str(trial) for trial in parts.trials] == [str(trial) for trial in whole.trials]
    assert whole.trials[0].markers == 30
    assert whole.trials[0].followed_share == 1


def test_a_data_set_gives_what_the_tracker_gives(trials, tmp_path):
    trial = trials["chromatouch"]
    data = save_dataset(tmp_path / "data", trial, split="test", simulated=True).folder
    output = tmp_path / "tracks.parquet"
    typed("track", data, "-o", output, "--markers", "chromatouch")
    table = pq.read_table(output)
    tracks = track_markers(trial.frames, trial.reference, "chromatouch")
    expected = tracks.displacement_px[..., 0].ravel().astype(np.float32)
    np.testing.assert_allclose(table["dx_px"].to_numpy(), expected, atol=1e-4)
    np.testing.assert_allclose(np.unique(table["time_s"].to_numpy()), trial.time_s)
