"""What the Rerun viewer is given of a trial, read back with Rerun's own reader."""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from data_sets import save_dataset
from made_up import explained
from rrd import read_rrd, shown
from there import there

import sliplens as sl
from sliplens.errors import InputError
from sliplens.images import read_image, write_png
from sliplens.live import viewer as viewer_process
from sliplens.recordings import Recording
from sliplens.results.explanation import ExplainedFrame, Explanation, MethodNotes
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

pytest.importorskip("rerun")

FRAMES = 20  # more than are sent together, and no multiple of them


def pictures(entities: dict[str, list[pa.RecordBatch]], entity: str) -> np.ndarray:
    _, blobs = shown(entities, entity, "EncodedImage:blob")
    return np.stack([read_image(bytes(blob), where=entity) for (blob,) in blobs])


@pytest.fixture(scope="module")
def trial() -> Recording:
    """A simulated trial with its truth."""
    return simulate_trial(replace(plan_trials(PRESETS["small"])[0], frames=FRAMES))


def test_frames_and_margins_come_back_as_they_are(trial: Recording, tmp_path: Path):
    data, told = save_dataset(tmp_path / "data", trial), []
    path = tmp_path / "new" / "a.rrd"
    sl.view(data.folder, out=path, on_progress=lambda done, total: told.append((done, total)))
    assert told == [(done, FRAMES) for done in range(1, FRAMES + 1)]
    assert list(path.parent.iterdir()) == [path]
    simulated = read_rrd(path)
    np.testing.assert_array_equal(pictures(simulated, "frame"), trial.frames)
    frames, margins = shown(simulated, "true", "Scalars:scalars")
    assert frames == np.flatnonzero(np.isfinite(trial.safety_margin)).tolist()  # before the contact there is none
    np.testing.assert_array_equal(np.ravel(margins), trial.safety_margin[frames])
    times_ns, _ = shown(simulated, "frame", "EncodedImage:blob", "time")
    np.testing.assert_array_equal(times_ns, np.round(1e9 * trial.time_s).astype(np.int64))


def test_what_networks_and_trackers_say_stands_on_the_clock_of_the_frames(trial: Recording, tmp_path: Path):
    data, frames = save_dataset(tmp_path / "data", trial), np.arange(0, FRAMES, 2)
    margin = np.random.default_rng(3).uniform(0, 1, len(frames))
    own = {"trial": [trial.trial] * len(frames), "frame": frames, "prediction": margin, "low_90": margin - 0.1}
    # another trial in the same table, and a network that tells no upper end
    others = {**own, "trial": ["other"] * len(frames), "prediction": margin + 1}
    table = pa.concat_tables([pa.table(others), pa.table(own)]).append_column(
        "high_90", pa.array([None] * (2 * len(frames)), pa.float64())
    )
    positions = there(trial.truth).marker_px[:, :3].copy()
    positions[5, 1] = np.nan
    flat, rest = positions.reshape(-1, 2), np.tile(positions[0], (FRAMES, 1))
    tracks = pa.table({
        "trial": [trial.trial] * len(flat), "frame": np.repeat(np.arange(FRAMES), 3),
        "rest_x_px": rest[:, 0], "rest_y_px": rest[:, 1], "x_px": flat[:, 0], "y_px": flat[:, 1],
    })  # fmt: skip
    margins, followed = tmp_path / "margins.parquet", tmp_path / "tracks.parquet"
    pq.write_table(table, margins)
    pq.write_table(tracks, followed)
    maps = explained_of(trial, [3, 4, 9])
    sl.view(data.folder, predictions=margins, maps=maps, tracks=followed, out=tmp_path / "a.rrd")
    found = read_rrd(tmp_path / "a.rrd")
    for entity, expected in {"margin": margin, "interval/low": margin - 0.1, "interval/high": np.array([])}.items():
        at, values = shown(found, entity, "Scalars:scalars")
        assert at == frames.tolist()[: len(expected)]
        np.testing.assert_allclose(np.ravel(values), expected)
    _, starts = shown(found, "frame/markers", "Arrows2D:origins")
    _, ways = shown(found, "frame/markers", "Arrows2D:vectors")
    assert [len(arrows) for arrows in ways][5] == 2
    # a pixel's centre is a whole number here, and a half more in Rerun
    np.testing.assert_allclose(np.array(starts[4]), positions[0] + 0.5, atol=1e-3)
    np.testing.assert_allclose(np.array(ways[4]), positions[4] - positions[0], atol=1e-3)
    assert shown(found, "map/poly-cam", "EncodedImage:blob")[0] == [3, 4, 9]
    assert shown(found, "map/poly-cam", "Clear:is_recursive")[0] == [5, 10]


def test_what_is_of_another_trial_is_refused(trial: Recording, tmp_path: Path):
    data = save_dataset(tmp_path / "data", trial)
    nothing = {"trial": ["other"], "frame": [0], "prediction": [0.5], "low_90": [0.1], "high_90": [0.9]}
    pq.write_table(pa.table(nothing), tmp_path / "margins.parquet")
    margins = tmp_path / "margins.parquet"
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"predictions": margins}, f"has no frame of {trial.trial}; it has other"),
        ({"maps": explained_of(replace(trial, trial="other"), [3])}, "of no frame of"),
        ({"tracks": margins}, "lacks the column"),
    ]
    for results, words in wrong:
        with pytest.raises(InputError, match=words):
            sl.view(data.folder, out=tmp_path / "a.rrd", **results)
    assert not (tmp_path / "a.rrd").exists()


def test_frames_of_any_source_are_viewed_alike(trial: Recording, tmp_path: Path):
    (tmp_path / "images").mkdir()
    for number, image in enumerate(trial.frames):
        write_png(tmp_path / "images" / f"{number:02}.png", image)
    sl.view(tmp_path / "images", out=tmp_path / "a.rrd")
    np.testing.assert_array_equal(pictures(read_rrd(tmp_path / "a.rrd"), "frame"), trial.frames)


def explained_of(trial: Recording, frames: list[int]) -> Explanation:
    """Maps of some frames of a trial, drawn by chance."""
    labels = [float(margin) if np.isfinite(margin) else None for margin in trial.safety_margin[frames]]
    facts = {"trial": trial.trial, "condition": trial.condition, "prediction": 0.5, "reference_prediction": 1.0}
    rows = tuple(
        ExplainedFrame(id=f"{trial.trial}-f{at:04d}", safety_margin=label, **facts)
        for at, label in zip(frames, labels, strict=True)
    )
    saliency = {"poly-cam": np.random.default_rng(1).random((len(frames), 224, 224), dtype=np.float32)}
    methods = {"poly-cam": MethodNotes(seconds_per_frame=0.1, warnings=())}
    return explained("difference", rows, methods, trial.frames[frames], saliency)


STAND_IN = """
import socket, sys, time
words = dict(zip(sys.argv[1::2], sys.argv[2::2]))
server = socket.create_server((words["--bind"], int(words["--port"])))
time.sleep(60)
"""


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], list[subprocess.Popen[bytes]]]:
    """Start a script in the viewer's place; gives the processes that were started."""

    def put(code: str) -> list[subprocess.Popen[bytes]]:
        script, begun = tmp_path / "viewer.py", []
        script.write_text(code)

        def popen(command: list[str], **settings: Any) -> subprocess.Popen[bytes]:
            assert command[1:3] == ["-m", "rerun_cli"]
            begun.append(real([command[0], str(script), *command[3:]], **settings))
            return begun[-1]

        monkeypatch.setattr(viewer_process.subprocess, "Popen", popen)
        return begun

    real: Any = subprocess.Popen
    return put


def test_the_viewer_listens_to_this_machine_alone(stand_in: Callable[[str], list[Any]]):
    begun = stand_in(STAND_IN)
    address = viewer_process.start_viewer()
    [process] = begun
    assert process.poll() is None
    process.kill()
    process.wait()
    assert process.args[process.args.index("--bind") + 1] == "127.0.0.1"
    assert address == f"rerun+http://127.0.0.1:{process.args[process.args.index('--port') + 1]}/proxy"


def test_a_viewer_that_finds_no_screen_is_told_with_its_reason(stand_in: Callable[[str], list[Any]]):
    # it listens first, and only then looks for a screen
    stand_in(STAND_IN.replace("time.sleep(60)", "time.sleep(0.3); sys.exit('Error: no DISPLAY is set')"))
    with pytest.raises(InputError, match=r"did not start \(Error: no DISPLAY is set\); write a file with --output"):
        viewer_process.start_viewer()
