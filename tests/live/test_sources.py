"""Running sources: each frame at its time, and the simulated fingertip under the load that it is given."""

import time

import numpy as np
import pytest
from there import there

import sliplens as sl
from sliplens.errors import InputError
from sliplens.live import LiveOptions, SimulatedSource, open_live
from sliplens.mechanics import safety_margin
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.sensor import SensorProfile


def test_a_trial_is_replayed_whole_with_its_labels_and_forces(small_dataset: Dataset):
    info = small_dataset.trials[0]
    recording = small_dataset.load(info)
    source = open_live(small_dataset.folder, options=LiveOptions(trial=info.trial, speed=20.0))
    frames = list(source.frames())
    assert source.count == len(frames) == len(recording.frames)
    np.testing.assert_array_equal([frame.image for frame in frames], recording.frames)
    np.testing.assert_array_equal(source.reference, recording.reference)
    np.testing.assert_allclose([frame.time_s for frame in frames], recording.time_s - recording.time_s[0])
    told = [np.nan if frame.safety_margin is None else frame.safety_margin for frame in frames]
    np.testing.assert_array_equal(told, recording.safety_margin)
    samples = np.concatenate([frame.forces.force_n[:, 2] for frame in frames if frame.forces is not None])
    np.testing.assert_array_equal(samples, recording.normal_force_n)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_no_frame_comes_before_its_time(small_dataset: Dataset, speed: float):
    source = open_live(small_dataset.folder, options=LiveOptions(speed=speed))
    frames = list(source.frames())
    spans = [(frame.captured_s - frames[0].captured_s) * speed for frame in frames]
    # clocks of the system tick in steps
    assert all(span >= frame.time_s - 1e-3 for span, frame in zip(spans, frames, strict=True))


def test_a_closed_source_ends_soon(recording: Recording):
    source = open_live(recording.frames, options=LiveOptions(rate_hz=0.1))
    frames = source.frames()
    next(frames)
    source.close()
    begun = time.monotonic()
    assert list(frames) == []
    assert time.monotonic() - begun < 5  # the next frame is due after 10 s


@pytest.mark.parametrize(("normal_n", "pull_n"), [(1.5, 0.0), (1.0, 0.3), (2.0, 1.2), (1.0, 5.0), (0.0, 1.0)])
def test_a_simulated_fingertip_has_the_margin_of_its_load(normal_n: float, pull_n: float):
    source = SimulatedSource(friction=0.6)
    source.load(normal_force_n=normal_n, tangential_force_n=pull_n)
    frame = next(source.frames())
    held_n, _, pressed_n = there(frame.forces).force_n[0]
    assert pressed_n == normal_n
    assert held_n == pytest.approx(min(pull_n, 0.6 * normal_n))
    if normal_n:
        assert frame.safety_margin == pytest.approx(float(safety_margin(normal_n, pull_n, 0.6)))
    else:
        assert frame.safety_margin is None
        # the reference, and nothing but the camera's noise, 2 grey levels in the background
        assert np.abs(frame.image.astype(int) - source.reference).mean() < 6


def test_the_grip_that_repeats_touches_slips_and_lets_go():
    source = SimulatedSource(rate_hz=30.0)
    loads = [source.forces_n(time_s) for time_s in (0.2, 1.5, 7.3, 9.0, 9.6)]
    margins = [1 - pull / (0.775 * press) if press else None for press, pull in loads]
    assert margins == [None, 1.0, pytest.approx(0.0), None, None]


@pytest.mark.parametrize("load", [(-1.0, 0.0), (1.0, -0.1), (np.nan, 0.0), (1.0, np.inf)])
def test_a_load_that_cannot_be_is_refused(load: tuple[float, float]):
    with pytest.raises(InputError, match="give forces of 0 or more"):
        SimulatedSource().load(normal_force_n=load[0], tangential_force_n=load[1])


@pytest.mark.parametrize(
    ("source", "options", "words"),
    [
        ("nowhere.mp4", LiveOptions(), "nowhere.mp4 is no source that is known, nor a path that exists"),
        ("simulated", LiveOptions(speed=2.0), "a simulated chromatouch takes no --speed; leave it out"),
        ("simulated:thumb", LiveOptions(), "no simulated sensor named 'thumb'; choose one of chromatouch, flat-gel"),
        ("7", LiveOptions(speed=2.0), "the camera /dev/video7 takes no --speed; leave it out"),
        ("rtsp://10.0.0.1/", LiveOptions(trial="a"), "takes no --trial; leave it out"),
    ],
)
def test_what_cannot_be_opened_is_told(source: str, options: LiveOptions, words: str):
    with pytest.raises(InputError, match=words):
        open_live(source, options=options)


def test_frames_and_reference_go_through_the_profile():
    frames = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), dtype=np.uint8)
    tip = SensorProfile(name="tip", camera_size_px=(64, 48), crop_px=(8, 0, 48, 48), resize_px=(24, 24))
    images: dict[int, np.ndarray] = {}
    reader = sl.LiveReader(frames, sensor=tip, reference=frames[1], health=None, slip=None)
    reader.subscribe(lambda _, frame: images.update({} if frame is None else {frame.number: frame.image}))
    with reader:
        assert list(reader.readings())[-1].withheld is None
        np.testing.assert_array_equal(reader.reference, tip.apply(frames[1]))
    assert images
    for number, image in images.items():
        np.testing.assert_array_equal(image, tip.apply(frames[number]))


@pytest.mark.parametrize("named", [None, "chromatouch-difference"])
def test_the_network_of_the_profile_is_used_where_no_other_is_named(named: str | None):
    reader = sl.LiveReader("simulated", named, sensor=SensorProfile(name="tip", network="chromatouch-pair"))
    assert reader.network is not None
    assert reader.network.manifest.input == ("pair" if named is None else "difference")
