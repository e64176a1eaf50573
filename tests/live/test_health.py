"""Health: each fault is told by its own check, and healthy frames by none."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

from sliplens.live import Check, HealthMonitor, LiveFrame, SimulatedSource
from sliplens.live.contract import Pace
from sliplens.live.health import check_novelty, margin_risk, severity
from sliplens.markers import Tracker
from sliplens.models.checkpoint import Estimate
from sliplens.recordings import Recording
from sliplens.recordings.capture import Forces

SIDE = 112


class Scene:
    """Dark spots on a bright ground, whose untouched picture a monitor has."""

    def __init__(self, rng: np.random.Generator) -> None:
        rows, columns = np.mgrid[:SIDE, :SIDE]
        spots = (np.cos(rows / 2.5) * np.cos(columns / 2.5)).clip(0.2, 0.6)
        self.rng, self.untouched = rng, 190 - 150 * spots[..., None] * np.array([0.8, 1.0, 0.6])
        self.monitor = HealthMonitor(self.shot(touches=False).image)

    def shot(
        self, picture: np.ndarray | None = None, *, number: int = 0, time_s: float = 0.0, touches: bool = True
    ) -> LiveFrame:
        """A noisy frame, touched in its middle."""
        touched = (self.untouched if picture is None else picture).copy()
        touched[40:72, 40:72] += 12 * touches
        pixels = np.clip(touched + self.rng.normal(0, 2, touched.shape), 0, 255).astype(np.uint8)
        return LiveFrame(image=pixels, number=number, time_s=time_s, captured_s=time.monotonic())

    def check(self, frame: LiveFrame) -> dict[str, Check]:
        return {check.name: check for check in self.monitor.check(frame)}

    def failed(self, frame: LiveFrame) -> set[str]:
        return {name for name, check in self.check(frame).items() if not check.ok}


@pytest.fixture
def scene(rng: np.random.Generator) -> Scene:
    return Scene(rng)


def blurred(picture: np.ndarray) -> np.ndarray:
    """Each pixel the mean of 5 x 5."""
    padded = np.pad(picture, ((2, 2), (2, 2), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(0, 1)).mean(axis=(-1, -2))


@pytest.mark.parametrize(("rate_hz", "frames"), [(60.0, 3), (30.0, 3), (5.0, 1)])
def test_what_changes_slowly_takes_turns_and_is_told_within_a_tenth_of_a_second(
    scene: Scene, rate_hz: float, frames: int
):
    for number in range(4):
        checks = scene.check(scene.shot(number=number, time_s=number / rate_hz))
        assert all(check.ok for check in checks.values())
        ages_s = {name: check.age_s for name, check in checks.items()}
        assert max(ages_s.values()) < 0.1
        assert {name for name, age_s in ages_s.items() if age_s > 0} <= {"focus", "light", "camera"}
    bare = np.roll(scene.untouched, 3, axis=1)  # of an untouched sensor: in a contact a shift does not count
    times_s = (4 + np.arange(frames)) / rate_hz
    told = [scene.failed(scene.shot(bare, time_s=time_s, touches=False)) for time_s in times_s]
    assert "camera" in told[-1]
    assert times_s[-1] - times_s[0] < 0.1


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.3])
def test_exposure_tells_the_factor(scene: Scene, factor: float):
    checks = scene.check(scene.shot(factor * scene.untouched))
    assert not checks["exposure"].ok
    assert checks["exposure"].value == pytest.approx(abs(np.log2(factor)), abs=0.03)
    assert f"{factor:.2g} times as bright as the reference; fix exposure" in checks["exposure"].sentence
    assert checks["light"].ok  # evenly brighter is no lamp
    assert checks["focus"].ok


@pytest.mark.parametrize(("down", "along"), [(2, 0), (0, -3), (3, 3)])
def test_a_camera_that_moved_is_told_in_pixels(scene: Scene, down: int, along: int):
    moved = np.roll(scene.untouched, (down, along), axis=(0, 1))
    for touches, time_s in ((False, 0.0), (True, 1.0)):  # before a contact, and therefore in it
        check = scene.check(scene.shot(moved, time_s=time_s, touches=touches))["camera"]
        # in pixels of a picture 224 high
        assert check.value == pytest.approx(2 * np.hypot(down, along), rel=0.1)
    assert "take a new reference" in check.sentence


def covered(level: float, picture: np.ndarray) -> np.ndarray:
    """A picture whose upper part is black or white."""
    return np.concatenate([np.full((30, *picture.shape[1:]), level), picture[30:]])


@pytest.mark.parametrize(
    ("fault", "name"),
    [
        (blurred, "focus"),
        (lambda picture: np.linspace(0.5, 1.0, SIDE)[None, :, None] * picture, "light"),
        (partial(covered, -10.0), "saturation"),
        (partial(covered, 265.0), "saturation"),
    ],
)
def test_a_fault_of_the_picture_fails_its_check(fault: Callable[[np.ndarray], np.ndarray], name: str, scene: Scene):
    assert name in scene.failed(scene.shot(fault(scene.untouched)))


def test_frames_that_repeat_come_late_or_are_lost_are_told(scene: Scene):
    frame = scene.shot()
    assert scene.failed(frame) == set()
    assert scene.failed(replace(frame, number=1, time_s=0.1)) == set()
    assert scene.failed(replace(frame, number=2, time_s=0.3)) == {"repeated"}
    assert scene.failed(scene.shot(number=3, time_s=0.4)) == set()
    late = scene.shot(number=4, time_s=0.5)
    assert scene.failed(replace(late, captured_s=late.captured_s - 2)) == {"late"}
    assert scene.failed(scene.shot(number=90, time_s=0.6)) == {"drops"}


def stopping(scene: Scene, *, rows: slice, force_n: float | None) -> list[LiveFrame]:
    """Frames of a picture that deepens, some rows of which stop after the third, by a load that grows meanwhile."""
    frames = []
    for number in range(12):
        depth = np.full((SIDE, 1, 1), number)
        depth[rows] = min(number, 2)
        frame, forces = scene.shot(scene.untouched - 2.0 * depth, number=number, time_s=number / 30), None
        if force_n is not None:
            force = np.array([[0.0, 0.0, force_n * number]])
            forces = Forces(time_s=np.array([frame.time_s]), force_n=force, source="test")
        frames.append(replace(frame, forces=forces))
    return frames


@pytest.mark.parametrize(
    ("rows", "force_n", "expected"),
    [
        (slice(0, 0), 0.1, set()),
        (slice(SIDE // 2, None), 0.1, {"halves"}),
        (slice(0, SIDE // 2), None, {"halves"}),
        (slice(0, SIDE), 0.1, {"frozen"}),
        (slice(0, SIDE), 0.0, set()),
        (slice(0, SIDE), None, set()),  # nothing but noise changes: a hand that holds still looks the same
    ],
)
def test_what_shows_noise_alone_while_something_else_changes_is_frozen(
    scene: Scene, rows: slice, force_n: float | None, expected: set[str]
):
    told = [scene.failed(frame) & {"halves", "frozen"} for frame in stopping(scene, rows=rows, force_n=force_n)]
    assert (told[2], told[-1]) == (set(), expected)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_a_grip_is_never_frozen_whichever_frames_are_lost(every: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Pace, "wait", lambda *_: True)
    with SimulatedSource(rate_hz=30.0) as source:
        assert source.reference is not None
        monitor, frames = HealthMonitor(source.reference), islice(source.frames(), 0, 270, every)
        checks = [check for frame in frames for check in monitor.check(frame) if check.name == "frozen"]
    assert max(check.value for check in checks) > 0
    assert all(check.ok for check in checks)


def test_without_a_touch_there_is_nothing_to_tell(scene: Scene):
    checks = scene.check(scene.shot(touches=False))
    assert {name for name, check in checks.items() if not check.ok} == {"touch"}
    assert max(map(severity, checks.values())) > 1


def test_markers_that_are_hidden_are_counted(trials: dict[str, Recording]):
    trial = trials["chromatouch"]
    tracker = Tracker(trial.reference)
    count = len(tracker.rest)
    picture = trial.reference.copy()
    hidden = tracker.rest.centre_px[: count // 3]
    for along, down in hidden.round().astype(int):
        picture[down - 9 : down + 10, along - 9 : along + 10] = np.median(picture, axis=(0, 1))
    monitor = HealthMonitor(trial.reference)
    frame = LiveFrame(image=picture, number=0, time_s=0.0, captured_s=0.0)
    [check] = [check for check in monitor.check(frame, tracker.update(picture)) if check.name == "markers"]
    # patches may cut neighbours: no fewer than were hidden
    assert len(hidden) / count - 0.05 <= check.value < 0.6
    assert not check.ok


@pytest.mark.parametrize(("known", "ok"), [(0.5, True), (0.011, True), (0.009, False), (1e-12, False), (0.0, False)])
def test_a_frame_is_strange_where_predict_withholds_it(known: float, ok: bool):
    check = check_novelty(Estimate(margin=np.array([0.5]), calibration=None, known=np.array([known])))
    assert check is not None
    assert check.ok == ok
    assert (severity(check) <= 1) == ok


def check_of(name: str, value: float, *, limit: float = 1.0) -> Check:
    return Check(name=name, value=value, limit=limit, ok=value <= limit, sentence="")


def test_risk_is_that_of_causes_which_each_suffice():
    harm, sure = {"camera": (0.6, 1.0), "light": (0.5, 1.0)}, (0.0, 1.0)
    quiet = margin_risk((), 0.3, harm=harm, spread=sure)
    assert quiet == pytest.approx(0.3, abs=0.01)  # the network alone, as it says itself
    camera, light = check_of("camera", 9.0), check_of("light", 9.0)
    # far beyond its limit each puts the margin off with its own chance, and both miss it together
    assert margin_risk((camera,), 0.0, harm=harm, spread=sure) == pytest.approx(0.6, abs=0.01)
    both = margin_risk((camera, light), 0.3, harm=harm, spread=sure)
    assert both == pytest.approx(1 - 0.7 * 0.4 * 0.5, abs=0.01)
