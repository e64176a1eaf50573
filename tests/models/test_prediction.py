"""Predictions: those of the network, one frame at a time, from every kind of source."""

import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from own_recording import write_images

import sliplens as sl
from sliplens.codec import TABLE_SUFFIXES
from sliplens.errors import ImageError, InputError
from sliplens.images import absolute_difference, write_png
from sliplens.markers.camera import CAMERA_REASON
from sliplens.models import Network
from sliplens.models.checkpoint import STRANGE_REASON
from sliplens.models.predictions import Predictions, lowest_frame
from sliplens.models.predictions import predict as predict_source
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.capture import Capture
from sliplens.recordings.trial import ContactState

TRIAL = "test-wet-7"


@pytest.fixture
def trained(networks: dict[str, Network]) -> Network:
    return networks["histogram"]


@pytest.fixture
def foreign(trials: dict[str, Recording]) -> Recording:
    """Frames of a sensor that the networks of the package never saw."""
    return trials["flat-gel"]


@pytest.fixture
def wet(small_dataset: Dataset) -> Recording:
    return small_dataset.load(small_dataset.select(split="test", condition="wet")[0])


def predict(source: Path, trained: Network, path: Path, *, batch_size: int = 5, **options: object) -> dict[str, list]:
    predict_source(trained, source, out=path, batch_size=batch_size, engine="torch", **options)  # pyright: ignore
    return pq.read_table(path).to_pydict()


def one_by_one(trained: Network, frames: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The slow way: each frame by itself."""
    return np.array([trained.estimate(trained.encode(frame[None], reference)).margin[0] for frame in frames])


def test_a_data_set_is_predicted_frame_by_frame(
    trained: Network, small_dataset: Dataset, wet: Recording, tmp_path: Path
):
    rows = predict(small_dataset.folder, trained, tmp_path / "a.parquet", split="test")
    labels = ["safety_margin", "normal_force_n", "tangential_force_n", "touches"]
    assert list(rows) == ["trial", "frame", "time_s", *labels, "prediction", "sigma", "low_90", "high_90", "withheld"]
    assert rows["trial"] == ["test-dry-6"] * 12 + [TRIAL] * 12
    assert rows["frame"] == [*range(12), *range(12)]
    assert rows["time_s"][12:] == wet.time_s.tolist()
    assert rows["touches"][12:] == [state != ContactState.NO_CONTACT for state in wet.contact_state]
    # the first frame has no contact, and so no label
    assert rows["safety_margin"][12] is None
    assert rows["safety_margin"][13:] == wet.safety_margin[1:].tolist()
    # float32 sums of a batch in another order than of one frame
    np.testing.assert_allclose(rows["prediction"][12:], one_by_one(trained, wet.frames, wet.reference), atol=1e-5)


NETWORK_COLUMNS = ("prediction", "sigma", "low_90", "high_90", "traction_ratio", "traction_ratio_sigma")


@pytest.mark.parametrize("suffix", [None, *TABLE_SUFFIXES])
def test_where_a_frame_is_withheld_the_table_holds_no_answer_of_the_network(
    foreign: Recording, tmp_path: Path, suffix: str | None
):
    out = None if suffix is None else tmp_path / f"margins{suffix}"
    predictions = sl.predict("chromatouch-difference", foreign.frames, reference=foreign.reference, out=out)
    rows = predictions.to_arrow()
    reasons = rows["withheld"].to_pylist()
    assert {None, STRANGE_REASON} <= set(reasons)  # the untouched frames are not judged
    assert [reason is not None for reason in reasons] == rows["touches"].to_pylist()
    for name in NETWORK_COLUMNS:
        assert [value is None for value in rows[name].to_pylist()] == [reason is not None for reason in reasons]
    assert predictions.withheld == Counter(filter(None, reasons))
    assert lowest_frame(rows) is None  # every frame that touches is withheld
    assert None not in rows["known"].to_pylist()  # it is what the reason was found by


def test_the_lowest_margin_is_of_a_frame_that_touches(trained: Network, wet: Recording):
    noise = np.random.default_rng(0).integers(-3, 4, (6, *wet.reference.shape))
    untouched = np.clip(wet.reference.astype(int) + noise, 0, 255).astype(np.uint8)
    frames = np.concatenate([untouched, wet.frames[4:]])
    rows = predict_source(trained, frames, reference=wet.reference).to_arrow()
    assert rows["touches"].to_pylist() == [False] * 6 + [True] * 8
    margins = rows["prediction"].to_numpy()
    assert lowest_frame(rows) == 6 + int(margins[6:].argmin())
    assert lowest_frame(rows[:6]) == int(margins[:6].argmin())


def test_a_folder_of_frames_and_its_differences_are_the_same(trained: Network, wet: Recording, tmp_path: Path):
    frames = write_images(tmp_path / "frames", wet.frames, "frame{}.png")  # frame10 after frame9, not after frame1
    compared = write_images(tmp_path / "compared", absolute_difference(wet.frames, wet.reference))
    write_png(tmp_path / "untouched.png", wet.reference)
    first = predict(frames, trained, tmp_path / "a.parquet", reference=tmp_path / "untouched.png")
    second = predict(compared, trained, tmp_path / "b.parquet")
    assert first["prediction"] == second["prediction"]
    assert first["file"] == [f"frame{index}.png" for index in range(12)]
    assert set(first["time_s"]) == {None}
    assert "safety_margin" not in first
    np.testing.assert_allclose(first["prediction"], one_by_one(trained, wet.frames, wet.reference), atol=1e-5)


def refused(source: Path, trained: Network, kind: type[Exception], message: str, **options: object) -> None:
    with pytest.raises(kind, match=message):
        predict_source(trained, source, **options)  # pyright: ignore[reportArgumentType]


def test_what_is_missing_or_too_much_is_refused(
    trained: Network, small_dataset: Dataset, wet: Recording, tmp_path: Path
):
    image, data = tmp_path / "untouched.png", small_dataset.folder
    folder = write_images(tmp_path / "frames", wet.frames)
    write_png(image, wet.reference)
    small = write_images(tmp_path / "small", np.ascontiguousarray(wet.frames[:, :40]))
    refused(folder, trained, InputError, "named twice", reference=image, reference_frame=0)
    refused(data, trained, InputError, "bring their reference frames", reference=image)
    refused(small, trained, ImageError, "40 x 48 pixels", reference_frame=0, out=tmp_path / "a.parquet")
    assert not (tmp_path / "a.parquet").exists()


def frames_of(recording: Recording, read_frames: Callable[[], Iterator[np.ndarray]], *, frames: int) -> Capture:
    size = recording.reference.shape[:2]
    return Capture(
        trial="trial",
        source="a test",
        frame_time_s=np.full(frames, np.nan),
        frame_size=(size[0], size[1]),
        read_frames=read_frames,
        reference=recording.reference,
    )


def test_only_one_batch_of_frames_is_held(trained: Network, wet: Recording, tmp_path: Path):
    alive, most = 0, 0

    def die() -> None:
        nonlocal alive
        alive -= 1

    def frames() -> Iterator[np.ndarray]:
        nonlocal alive, most
        for index in range(70):
            frame = wet.frames[index % 12].copy()
            weakref.finalize(frame, die)
            alive += 1
            most = max(most, alive)
            yield frame

    trial = frames_of(wet, frames, frames=70)
    seen = []
    predict_source(
        trained,
        [trial],
        out=tmp_path / "a.parquet",
        engine="torch",
        batch_size=4,
        on_progress=lambda done, total: seen.append((done, total)),
    )
    # the next frame is read while the last batch still has its name
    assert most <= 2 * 4 + 1
    assert seen == [(64, 70), (70, 70)]  # after 16 batches, and at the end


def test_rows_in_memory_are_those_of_the_file(trained: Network, small_dataset: Dataset, tmp_path: Path):
    written = predict_source(trained, small_dataset, split="test", out=tmp_path / "a.parquet")
    kept = predict_source(trained, small_dataset, split="test")
    assert kept.to_arrow().equals(written.to_arrow(), check_metadata=True)
    assert kept.frames == kept.to_arrow().num_rows == 24


def test_another_process_writes_the_same_bytes_and_a_folder_is_a_data_set_of_them(
    trained: Network, small_dataset: Dataset, tmp_path: Path, elsewhere: str
):
    def write(path: Path, **options: object) -> Predictions:
        return predict_source(trained, small_dataset.folder, out=path, **own, **options)  # pyright: ignore

    own: dict[str, Any] = {"split": "test", "engine": "torch"}
    serial, others = write(tmp_path / "a.parquet"), write(tmp_path / "b.parquet", on=elsewhere)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    folder = write(tmp_path / "set")
    assert folder.to_arrow().to_pylist() == serial.to_arrow().to_pylist() == others.to_arrow().to_pylist()
    assert sorted(path.name for path in (tmp_path / "set").iterdir()) == [
        "run.json",
        "trial=test-dry-6",
        f"trial={TRIAL}",
    ]
    refused(small_dataset.folder, trained, InputError, "other settings", out=tmp_path / "set", engine="torch")
    same = [replace(info, sha256="0" * 64) for info in small_dataset.trials]  # frames that changed
    with pytest.raises(InputError, match="other settings"):
        predict_source(trained, replace(small_dataset, trials=tuple(same)), out=tmp_path / "set", **own)
    frames = np.zeros((2, 48, 48, 3), dtype=np.uint8)
    with pytest.raises(InputError, match="frames in memory are worked on in this process"):
        predict_source(trained, frames, on="processes")


@pytest.mark.parametrize("degrees", [0.0, 1.5, -3.0])
def test_frames_of_a_camera_that_has_turned_are_withheld(trials: dict[str, Recording], degrees: float):
    trial = trials["chromatouch"]
    turn = cv2.getRotationMatrix2D((111.5, 111.5), degrees, 1.0)
    frames = np.stack(
        [cv2.warpAffine(frame, turn, (224, 224), borderMode=cv2.BORDER_REPLICATE) for frame in trial.frames]
    )
    predictions = sl.predict("chromatouch-pair", frames, reference=trial.reference)
    turned = predictions.withheld.get(CAMERA_REASON, 0)
    assert turned == (len(frames) if degrees else 0)
