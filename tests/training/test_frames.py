from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_sets import save_dataset

from sliplens.errors import RecordingError
from sliplens.models.encodings import ENCODINGS
from sliplens.recordings import Dataset, Recording
from sliplens.training.data import UNTOUCHED, EpochShuffle, load_frames


def test_a_batch_is_what_encoding_the_frames_one_by_one_gives(small_dataset: Dataset):
    trials = small_dataset.select(split="test")
    encoding = ENCODINGS["difference"]
    frames = load_frames(small_dataset, trials, encoding=encoding, image_size=24)
    recording = small_dataset.load(trials[1])
    images, labels, _ = frames.__getitems__([11, 15])
    assert frames.trial[11] == recording.trial
    expected = encoding.encode(recording.frames[[1, 5]], recording.reference, image_size=24)
    assert torch.equal(images, expected)
    np.testing.assert_allclose(labels.numpy(), recording.safety_margin[[1, 5]], rtol=1e-6)
    assert torch.equal(frames.__getitems__([11])[0][0], images[0])


def test_the_untouched_sensor_is_added_as_full_stick_only_when_asked_for(small_dataset: Dataset):
    trials = small_dataset.select(split="train")
    plain, more = (
        load_frames(small_dataset, trials, encoding=ENCODINGS["difference"], image_size=32, untouched_share=share)
        for share in (0.0, 0.2)
    )
    added = [row for row, frame in enumerate(more.frame) if frame == UNTOUCHED]
    assert len(more) == len(plain) + len(added)
    assert len(added) == 4 * 2  # a fifth of 11 labelled frames, rounded, in each of four trials
    assert not more.images[added].any()
    assert more.safety_margin[added].eq(1).all()
    assert UNTOUCHED not in plain.frame


def test_frames_whose_label_cannot_be_trusted_are_left_out(tmp_path: Path, recording: Recording):
    doubted = replace(recording, valid=np.arange(12) < 7)
    data = save_dataset(tmp_path, doubted)
    frames = load_frames(data, data.trials, encoding=ENCODINGS["difference"], image_size=32)
    # frame 0 has no contact, frames 7 to 11 are not trusted
    assert frames.frame == (1, 2, 3, 4, 5, 6)


def test_frames_of_two_sizes_are_refused(tmp_path: Path, recording: Recording):
    wider = replace(recording, trial="wider", frames=recording.frames[:, :, ::2], reference=recording.reference[:, ::2])
    data = save_dataset(tmp_path, recording, replace(wider, truth=None))
    with pytest.raises(RecordingError, match=r"mixes frames of .* use one sensor at a time"):
        load_frames(data, data.trials, encoding=ENCODINGS["difference"], image_size=32)


def test_frames_that_do_not_fit_in_memory_are_the_same(
    tmp_path: Path, small_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
):
    options = {"encoding": ENCODINGS["difference"], "image_size": 24}
    trials = small_dataset.select(split="test")
    held = load_frames(small_dataset, trials, **options)
    monkeypatch.setattr("os.sysconf", lambda _: 1)
    assert torch.equal(load_frames(small_dataset, trials, scratch=tmp_path, **options).images, held.images)
    assert not list(tmp_path.iterdir())


def order(epoch: int, count: int, **options: int) -> list[int]:
    shuffle = EpochShuffle(count, seed=1, **options)
    shuffle.set_epoch(epoch)
    assert len(list(shuffle)) == len(shuffle)
    return list(shuffle)


@pytest.mark.parametrize(("count", "drawn"), [(20, 20), (20, 7), (7, 20), (5, 15)])
def test_each_epoch_has_an_order_that_repeats_and_draws_all_frames_alike(count: int, drawn: int):
    assert order(2, count, drawn=drawn) == order(2, count, drawn=drawn) != order(3, count, drawn=drawn)
    times = np.bincount(order(2, count, drawn=drawn), minlength=count)
    assert times.sum() == drawn
    assert np.ptp(times) <= 1
