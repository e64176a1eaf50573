from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import UInt8
from matplotlib.colors import to_rgb

from sliplens.errors import InputError
from sliplens.images import absolute_difference
from sliplens.plots.clip import clip_frames, write_clip
from sliplens.plots.contact_sheet import brighten, brightening, paint_outlines
from sliplens.plots.style import SKY
from sliplens.progress import reporting
from sliplens.recordings import ContactState, Recording

av = pytest.importorskip("av")


def read(path: Path) -> tuple[UInt8[np.ndarray, "frames height width 3"], float, str]:
    """Frames, duration in seconds and pixel format of a clip."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(stream)])
        return frames, float(stream.duration * stream.time_base), stream.codec_context.pix_fmt


@pytest.fixture(scope="module")
def trial() -> Recording:
    """Twenty frames in two seconds: a bright square goes to the right over a dark sensor."""
    count = 20
    reference = np.full((24, 32, 3), 30, dtype=np.uint8)
    frames = np.repeat(reference[None], count, axis=0)
    for index in range(count):
        frames[index, 8:16, index : index + 8] = (150, 90, 60)
    margin = np.linspace(1, 0, count)
    return Recording(
        trial="day1-wet-001",
        sensor="test-sensor",
        day=1,
        condition="wet",
        reference=reference,
        frames=frames,
        time_s=5 + 0.1 * np.arange(count),
        normal_force_n=np.ones(count),
        tangential_force_n=0.5 * (1 - margin),
        friction_coefficient=np.full(count, 0.5),
        safety_margin=margin,
        stick_ratio=margin ** (2 / 3),
        contact_state=(ContactState.INCIPIENT_SLIP,) * (count - 1) + (ContactState.FULL_SLIP,),
    )


@pytest.fixture(scope="module")
def written(trial, tmp_path_factory) -> tuple[Path, list[tuple[int, int]]]:
    """The clip of the trial, and what was told while it was written."""
    path = tmp_path_factory.mktemp("clip") / "new" / "trial.mp4"
    told = []
    with reporting(lambda done, total: told.append((done, total))):
        write_clip(trial, path)
    return path, told


def test_clip_plays_in_browsers_as_long_as_its_recording(written):
    frames, duration, pixel_format = read(written[0])
    data = written[0].read_bytes()

    # twenty frames, each a tenth of a second; one frame of the clip may be gained or lost
    assert duration == pytest.approx(2.0, abs=1 / 30 + 1e-3)
    assert written[1] == [(done, 60) for done in range(1, 61)]
    assert len(frames) == 60
    assert pixel_format == "yuv420p"
    assert frames.shape[1] % 2 == frames.shape[2] % 2 == 0
    assert data.index(b"moov") < data.index(b"mdat")


def test_clip_shows_camera_and_difference_enlarged(trial, written):
    frames, _, _ = read(written[0])
    rows, columns = 24 * 20, 32 * 20  # the largest whole factor within 480 x 640 pixels
    factor = brightening([absolute_difference(trial.frames, trial.reference)])

    for shown, index in ((0, 0), (30, 10), (59, 19)):
        difference = brighten(absolute_difference(trial.frames[index], trial.reference), factor)
        for expected, left in ((trial.frames[index], 0), (difference, columns)):
            seen = frames[shown, :rows, left : left + columns]
            blocks = seen.reshape(24, 20, 32, 20, 3).mean(axis=(1, 3))
            # H.264 at this quality errs by a few levels where nothing changes, Lanczos rings at edges
            assert np.abs(blocks - expected).mean() < 4


@pytest.mark.parametrize("frames_per_s", [25.0, 30.0, 12.5])
def test_each_moment_shows_the_nearest_frame(frames_per_s, rng):
    time_s = 3 + np.cumsum(rng.uniform(0.01, 0.2, 40))

    shown = clip_frames(time_s, frames_per_s)

    moments = time_s[0] + np.arange(len(shown)) / frames_per_s
    assert shown.tolist() == [int(np.argmin(np.abs(time_s - moment))) for moment in moments]
    whole = time_s[-1] - time_s[0] + np.median(np.diff(time_s))
    assert len(shown) / frames_per_s == pytest.approx(whole, abs=1 / frames_per_s)


def test_single_frame_is_a_clip_of_one_frame(trial, tmp_path):
    signals = ("time_s", "normal_force_n", "tangential_force_n", "friction_coefficient", "safety_margin", "stick_ratio")
    one = replace(
        trial,
        frames=trial.frames[:1],
        contact_state=trial.contact_state[:1],
        **{name: getattr(trial, name)[:1] for name in signals},
    )

    write_clip(one, tmp_path / "one.mp4")

    assert len(read(tmp_path / "one.mp4")[0]) == 1


@pytest.mark.parametrize(("size", "shown"), [((1081, 101), (540, 640)), ((101, 1921), (34, 1282))])
def test_large_frames_are_reduced_by_a_whole_factor(trial, tmp_path, size, shown):
    black = np.zeros((*size, 3), dtype=np.uint8)

    write_clip(replace(trial, reference=black, frames=np.stack([black] * len(trial))), tmp_path / "a.mp4")

    assert read(tmp_path / "a.mp4")[0][0].shape[:2] == (shown[0] + 60, shown[1])


def test_outlines_do_not_hide_each_other_or_leave_their_side():
    contact = np.zeros((40, 40), dtype=np.uint8)
    contact[10:30, 10:30] = 2
    picture = np.full((480, 480, 3), 77, dtype=np.uint8)

    paint_outlines(picture, contact)

    inside = np.zeros((480, 480), dtype=bool)
    inside[120:360, 120:360] = True  # twelvefold
    white = (picture == 255).all(axis=-1)
    blue = (picture == np.round(255 * np.array(to_rgb(SKY)))).all(axis=-1)
    assert white.any()
    assert blue.any()
    assert not (white & inside).any()
    assert not (blue & ~inside).any()
    assert (picture[240, 240] == picture[5, 5]).all()
    assert (picture[5, 5] == 77).all()


@pytest.mark.parametrize(
    ("name", "rate", "message"),
    [("trial", 30.0, "name a clip"), ("trial.mp4.mkv", 30.0, "name a clip")]
    + [("trial.mp4", rate, "cannot be watched; ask for 25 to 30") for rate in (0.0, 1e6, float("nan"))],
)
def test_another_suffix_or_rate_is_refused_and_nothing_written(trial, tmp_path, name, rate, message):
    with pytest.raises(InputError, match=message):
        write_clip(trial, tmp_path / name, frames_per_s=rate)
    assert not list(tmp_path.iterdir())


def test_interrupted_clip_leaves_the_one_before(trial, tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    (tmp_path / "trial.mp4").write_bytes(b"yesterday's")
    with pytest.raises(KeyboardInterrupt), reporting(stop):
        write_clip(trial, tmp_path / "trial.mp4")

    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("trial.mp4", b"yesterday's")]
