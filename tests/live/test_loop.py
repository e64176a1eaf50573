"""The loop: what is read is what `predict` reads, what is not is counted, and nobody waits."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scripted import Scripted, frames_of, plain_reader, source_of
from there import there
from threadpoolctl import threadpool_info, threadpool_limits

import sliplens as sl
from sliplens.errors import ImageError, InputError
from sliplens.live.reading import Check, LiveFrame, MarkerReading, Reading, SlipState
from sliplens.markers import Tracker
from sliplens.recordings import ContactState, Dataset, Recording


def watch(read: Callable[[float], MarkerReading]) -> Callable[[np.ndarray], Any]:
    """Make slip detectors that say of each time what they are given to say."""
    return lambda _: SimpleNamespace(update=lambda _, time_s: read(time_s))


def judge(*checks: Callable[[LiveFrame], Check]) -> Callable[[np.ndarray], Any]:
    """Make monitors whose health is that of some checks."""
    return lambda _: SimpleNamespace(check=lambda frame, _: tuple(check(frame) for check in checks))


@pytest.fixture
def recording(small_dataset: Dataset) -> Recording:
    return small_dataset.load(small_dataset.trials[0])


def test_a_reading_is_what_predict_says_of_the_frame(recording: Recording, difference_run: Path):
    table = sl.predict(difference_run, recording.frames, reference=recording.reference).to_arrow()
    told = table.column("prediction").to_numpy()
    readings = source_of(recording.frames).all_readings(difference_run, reference=recording.reference)
    assert len(readings) == 12
    for reading in readings:
        assert reading.withheld is None
        # one frame at a time or many: float32 sums in another order
        assert reading.margin == pytest.approx(np.clip(told[reading.number], 0, 1), abs=1e-4)


@pytest.mark.parametrize("wait_s", [0.0, 0.01])
def test_every_frame_is_read_or_counted_as_dropped(recording: Recording, wait_s: float):
    frames = [step for frame in frames_of(recording.frames) for step in (lambda _: time.sleep(wait_s), frame)]
    source = Scripted(*frames, patient=False)
    reader = plain_reader(source, reference=recording.reference)
    reader.subscribe(lambda *_: time.sleep(0.004))
    heard = source.all_readings(reader)
    numbers = [reading.number for reading in heard]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == len(recording.frames) - 1  # the newest is never the one that is dropped
    # those before the first that is read were put in its place: they count from the second reading on
    assert len(heard) + heard[-1].dropped + numbers[0] == len(recording.frames)


def test_who_asks_late_gets_the_newest_and_is_not_left_waiting(recording: Recording):
    with plain_reader(source_of(recording.frames[:2], patient=False), reference=recording.reference) as reader:
        early = reader.readings()
        assert reader._over.wait(timeout=10)
        for readings in early, reader.readings():
            assert [reading.number for reading in readings] == [1]


def test_without_a_reference_the_first_still_picture_is_taken(recording: Recording, rng: np.random.Generator):
    moving = rng.integers(0, 255, (6, 48, 48, 3), dtype=np.uint8)
    still = np.repeat(recording.reference[None] + np.uint8(40), 10, axis=0)
    source = source_of(np.concatenate([moving, still]))
    reader = plain_reader(source)
    readings = source.all_readings(reader)
    assert "no reference frame yet" in str(readings[0].withheld)
    assert readings[-1].withheld is None
    np.testing.assert_array_equal(reader.reference, still[0])


def test_a_new_reference_is_taken_on_request(recording: Recording):
    light = recording.reference + np.uint8(60)
    source = source_of(np.repeat(light[None], 30, axis=0))
    reader = plain_reader(source, reference=recording.reference)

    def ask(reading: Reading, _: LiveFrame | None) -> None:
        if reading.number == 0:
            np.testing.assert_array_equal(reader.reference, recording.reference)
            reader.take_reference()

    reader.subscribe(ask)
    source.all_readings(reader)
    np.testing.assert_array_equal(reader.reference, light)


def test_a_margin_is_withheld_where_a_check_fails(recording: Recording, difference_run: Path):
    def even(frame: LiveFrame) -> Check:
        odd = frame.number % 2
        return Check(name="even", value=float(odd), limit=0.0, ok=not odd, sentence="odd; wait for the next")

    settings = {"reference": recording.reference, "health": judge(even)}
    readings = source_of(recording.frames).all_readings(difference_run, **settings)
    assert {(reading.number % 2 == 1, reading.margin is None, bool(reading.withheld)) for reading in readings} == {
        (False, False, False),
        (True, True, True),
    }


def test_every_margin_has_the_novelty_of_its_very_frame(trials: dict[str, Recording]):
    trial, network = trials["chromatouch"], sl.load("chromatouch-pair")
    touching = trial.frames[np.isfinite(trial.safety_margin)]
    whole, torn = touching[::8], touching[4::8].copy()
    torn[:, 112:] = 0  # the lower part never came
    whole = whole[: len(torn)]
    frames = np.stack([whole, torn], axis=1).reshape(-1, *trial.frames.shape[1:])  # far less than 0.25 s apart
    known = sl.predict(network, frames, reference=trial.reference).to_arrow()["known"].to_numpy()
    assert (known[1::2] < 0.01).any()
    assert (known[::2] > 0.01).any()
    readings = source_of(frames).all_readings(network, reference=trial.reference, health=judge())
    for reading, share in zip(readings, known, strict=True):
        if not all(check.ok for check in reading.health if check.name == "direction"):
            continue  # the network was not run
        [check] = [check for check in reading.health if check.name == "novelty"]
        assert (reading.margin is None) == (share < 0.01)
        # one frame at a time or many: float32 sums in another order move the features by 1e-6, the logarithm by more
        assert check.value == pytest.approx(-np.log10(share), abs=1e-2)


def test_markers_are_followed_for_whoever_tells_slip(trials: dict[str, Recording]):
    trial, source = trials["chromatouch"], source_of(trials["chromatouch"].frames[:1])
    reader = plain_reader(source, reference=trial.reference, slip=watch(grasp))
    assert [reading.slip for reading in source.all_readings(reader)] == [SlipState.STICKING]
    # markers of the untouched sensor, seen within a pixel
    between = there(trial.truth).marker_px[0][:, None] - there(reader.markers_px)[1][None]
    assert np.nanmax(np.linalg.norm(between, axis=-1).min(axis=0)) < 1


@pytest.mark.parametrize("named", [False, True])
def test_without_a_contact_there_is_no_margin(trials: dict[str, Recording], named: bool):
    trial = trials["chromatouch"]
    touched = watch(lambda time_s: MarkerReading(state=SlipState.CANNOT_TELL, contact=time_s > 0))
    source, network = source_of(trial.frames[:2]), "chromatouch-difference" if named else None
    first, second = source.all_readings(network, reference=trial.reference, slip=touched)
    assert first.contact_state is ContactState.NO_CONTACT
    assert first.margin is None
    assert (first.withheld is not None) == named
    assert (second.margin is not None) == named
    assert second.contact_state is not ContactState.NO_CONTACT


def test_what_is_told_of_friction_shapes_the_margin_and_a_slip_narrows_it(
    trials: dict[str, Recording], ratio_run: Path
):
    trial, network = trials["chromatouch"], sl.load(ratio_run)
    slips = watch(lambda time_s: grasp(0.15 if time_s > 0.12 else 0.0))
    told, source = sl.Friction.between(0.3, 0.9), source_of(trial.frames[10:14])
    readings = source.all_readings(network, reference=trial.reference, friction=told, slip=slips)
    estimates = [network.estimate(network.encode(frame[None], trial.reference)) for frame in trial.frames[10:14]]
    ratios = [one.ratio for one in estimates if one.ratio is not None]
    assert len(ratios) == 4
    assert [reading.ratio for reading in readings] == pytest.approx([float(one.mean[0]) for one in ratios], abs=1e-4)
    # the slip that the fourth frame tells began 0.06 s before it, after the second
    learnt = told.update(float(ratios[1].mean[0]), float(ratios[1].sigma[0]))
    assert [reading.friction for reading in readings] == [str(told)] * 3 + [str(learnt)]
    for reading, frame, friction in zip(readings, trial.frames[10:14], [told] * 3 + [learnt], strict=True):
        again = network.estimate(network.encode(frame[None], trial.reference), friction=friction)
        assert reading.margin == pytest.approx(float(again.margin[0]), abs=1e-4)


def grasp(time_s: float) -> MarkerReading:
    """A grasp, a slip in its fourth frame, and that it is let go in the last of each five."""
    place = round(time_s / 0.05) % 5
    if place == 4:
        return MarkerReading(state=SlipState.CANNOT_TELL, contact=False)
    return MarkerReading(state=SlipState.STICKING, contact=True, slipped_s=0.06 if place == 3 else None)


@pytest.mark.parametrize("same_object", [False, True])
def test_a_slip_teaches_the_next_grasp_of_the_same_object_until_there_is_another(
    trials: dict[str, Recording], *, same_object: bool
):
    trial = trials["chromatouch"]
    images = np.tile(trial.frames[10:15], (3, 1, 1, 1))
    options = {"same_object": same_object, "slip": watch(grasp)}
    reader = plain_reader(source := source_of(images), "chromatouch-difference", reference=trial.reference, **options)

    def hear(reading: Reading, _: object) -> None:
        if reading.number == 9:
            there(reader.learnt)
            reader.new_object()
            assert reader.learnt is None

    reader.subscribe(hear)
    readings = source.all_readings(reader)
    friction = [reading.friction for reading in readings]
    first, second, third = friction[:4], friction[5:9], friction[10:14]
    assert set(first) == set(third) == {None}
    assert all("learnt from slips" in str(one) for one in second) if same_object else set(second) == {None}


def test_a_network_of_another_sensor_is_refused_before_anything_runs(difference_run: Path):
    with pytest.raises(ImageError, match=r"224 x 224 pixels but the network was trained on 48 x 48"):
        plain_reader("simulated", difference_run).__enter__()


def test_by_default_health_and_slip_are_watched_and_no_touch_has_no_margin(trials: dict[str, Recording]):
    trial = trials["chromatouch"]
    untouched = np.flatnonzero(np.isnan(trial.safety_margin))[:2]
    touched = np.flatnonzero(np.isfinite(trial.safety_margin))[20:22]
    source = source_of(trial.frames[np.concatenate([untouched, touched])])
    readings = source.all_readings(sl.LiveReader(source, reference=trial.reference, stall_s=10.0))
    assert [reading.contact_state is ContactState.NO_CONTACT for reading in readings] == [True, True, False, False]
    assert "nothing touches the sensor; press it on something" in str(readings[0].withheld)
    assert {reading.slip for reading in readings} == {SlipState.CANNOT_TELL}  # not yet still for long enough
    assert {"exposure", "focus", "camera", "markers"} <= {check.name for check in readings[0].health}


def test_markers_of_a_large_frame_are_told_in_its_own_pixels(trials: dict[str, Recording]):
    trial = trials["chromatouch"]
    large = [np.kron(image, np.ones((2, 2, 1), dtype=np.uint8)) for image in (trial.reference, trial.frames[20])]
    source = source_of(np.stack([large[1]]))
    reader = sl.LiveReader(source, reference=large[0], stall_s=10.0)
    source.all_readings(reader)
    tracker = Tracker(large[0])  # in the frame itself
    expected = tracker.rest.centre_px, tracker.update(large[1]).position_px
    for told, known in zip(there(reader.markers_px), expected, strict=True):
        distance = np.linalg.norm(told[:, None] - known[None], axis=-1)
        distance = np.nanmin(np.where(np.isnan(distance), np.inf, distance), axis=1)
        assert np.mean(distance < 0.2) > 0.9  # those at the edge may be seen in one and cut in the other


def test_readers_that_end_in_any_order_give_the_process_its_threads_back(recording: Recording):
    def threads() -> set[float]:
        blas = {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}
        return {*blas, cv2.getNumThreads(), torch.get_num_threads(), sys.getswitchinterval()}

    torch_had, cv2_had = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits(2, user_api="blas"), ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch_had)
        stack.callback(cv2.setNumThreads, cv2_had)
        torch.set_num_threads(2)
        cv2.setNumThreads(2)
        readers = [plain_reader(source_of(recording.frames[:2], patient=False)) for _ in range(2)]
        for reader in readers:
            reader.__enter__()
        readers[0].__exit__(None, None, None)
        assert threads() == {1, 5e-4}
        readers[1].__exit__(None, None, None)
        assert threads() == {2, 5e-3}


@pytest.mark.parametrize("unit", ["", "N", "margin"])
def test_a_module_of_others_is_shown_live_only_if_it_predicts_margins(recording: Recording, unit: str):
    side = len(recording.reference)
    module = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * side**2, 1)).eval()
    network = sl.wrap(module, size=side, unit=unit)
    source = source_of(recording.frames[:2])
    if unit == "margin":
        assert len(source.all_readings(network, reference=recording.reference)) == 2
    else:
        with pytest.raises(InputError, match='unit="margin"'):
            sl.LiveReader(source, network, reference=recording.reference)
