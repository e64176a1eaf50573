"""Several frames: laws of the head that reads them, and of what is kept of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small import CALIBRATION
from there import there

import sliplens as sl
from sliplens.errors import InputError
from sliplens.models import Network, Ratio, load
from sliplens.models.checkpoint import Estimate
from sliplens.recordings import Dataset
from sliplens.recordings.source import open_source
from sliplens.recordings.trial import ContactState

EDGES, RATIO_EDGES = torch.linspace(-0.1, 1.1, 61), torch.linspace(-0.1, 1.5, 81)


@pytest.fixture(scope="module")
def run(sequence_run: Path) -> Network:
    return load(sequence_run)


def answers(frames: int, *, seed: int = 0) -> Estimate:
    """What a network might say of frames: distributions drawn at random."""
    rng = np.random.default_rng(seed)
    edges, ratio_edges = EDGES.double().numpy(), RATIO_EDGES.double().numpy()
    margin = rng.dirichlet(np.full(60, 0.3), frames)
    ratio = Ratio(probabilities=rng.dirichlet(np.full(80, 0.3), frames), edges=ratio_edges)
    mean = margin @ ((edges[1:] + edges[:-1]) / 2)
    return Estimate(margin=mean, calibration=CALIBRATION, probabilities=margin, edges=edges, ratio=ratio)


def follow(run: Network, estimate: Estimate, *, pieces: int = 1, touches: np.ndarray | None = None) -> np.ndarray:
    """Margins that are read from the frames in order, so many pieces of them at once; 30 frames a second."""
    follower, rows = run.follow(), np.arange(len(estimate.margin))
    touches = np.ones(len(rows), dtype=bool) if touches is None else touches
    parts = [follower.update(estimate.at(some), some / 30, touches[some]) for some in np.array_split(rows, pieces)]
    return np.concatenate([part.margin for part in parts])


def test_frames_one_by_one_are_read_as_all_at_once(run: Network):
    estimate = answers(17)
    assert np.array_equal(follow(run, estimate), follow(run, estimate, pieces=17))
    assert np.array_equal(follow(run, estimate), follow(run, estimate, pieces=4))


def test_an_answer_depends_on_the_frames_so_far_alone(run: Network):
    first, other = answers(12), answers(12, seed=1)
    mixed = replace(
        first, probabilities=np.concatenate([there(first.probabilities)[:7], there(other.probabilities)[7:]])
    )
    assert np.array_equal(follow(run, first)[:7], follow(run, mixed)[:7])
    assert not np.isclose(follow(run, first)[7:], follow(run, mixed)[7:]).any()


def test_memory_counts_and_ends_with_the_contact(run: Network):
    estimate = answers(6)
    twice = estimate.at(np.r_[0:6, 0:6])
    again = follow(run, twice)
    assert not np.isclose(again[6:], again[:6]).any()
    touches = np.ones(13, dtype=bool)
    touches[6] = False
    lifted = follow(run, estimate.at(np.r_[0:6, 0, 0:6]), touches=touches)
    # times differ by a shift, whose differences round
    np.testing.assert_allclose(lifted[7:], lifted[:6], atol=1e-6)
    assert lifted[6] == estimate.margin[0]


def test_after_a_gap_the_rest_of_a_contact_is_read_frame_by_frame(run: Network):
    estimate, follower = answers(18), run.follow()
    times, touches = np.arange(18) / 10, np.ones(18, dtype=bool)
    times[6:] += 30
    touches[11] = False
    read = follower.update(estimate, times, touches).margin
    assert not np.isclose(read[:6], estimate.margin[:6]).any()
    assert np.array_equal(read[6:12], estimate.margin[6:12])
    # the next contact is followed as if there had been none before
    anew = run.follow().update(estimate.at(np.arange(12, 18)), times[12:], touches[12:]).margin
    np.testing.assert_allclose(read[12:], anew, atol=1e-6)
    assert not follower.lost


def test_frames_whose_margin_is_withheld_leave_nothing_in_memory(run: Network):
    estimate, times, touches = answers(12), np.arange(12) / 10, np.ones(12, dtype=bool)
    believed = ~np.isin(np.arange(12), (0, 4, 5, 9))
    read = run.follow().update(estimate, times, touches, believed=believed).margin
    without = run.follow().update(estimate.at(np.flatnonzero(believed)), times[believed], touches[believed]).margin
    np.testing.assert_allclose(read[believed], without, atol=1e-6)
    assert np.array_equal(read[~believed], estimate.margin[~believed])


def test_frames_read_one_by_one_after_a_gap_keep_their_own_intervals(run: Network):
    kept, many = there(run.manifest.sequence), answers(12)
    wide = replace(kept.calibration, offsets={"0.9": 0.2})
    narrow = np.exp(-(((there(many.edges)[:-1] - np.linspace(0.3, 0.6, 12)[:, None]) / 0.05) ** 2))
    estimate = replace(many, probabilities=narrow / narrow.sum(axis=1, keepdims=True))
    follower = replace(run, manifest=replace(run.manifest, sequence=replace(kept, calibration=wide))).follow()
    times, after = np.arange(12) / 10 + 30 * (np.arange(12) >= 5), np.arange(5, 12)
    read = follower.update(estimate, times, np.ones(12, dtype=bool))
    own, as_several = (there(one.interval(0.9)) for one in (estimate, replace(estimate, calibration=wide)))
    for end, own_end, other_end in zip(there(read.interval(0.9)), own, as_several, strict=True):
        assert np.array_equal(end[5:], own_end[5:])
        assert not np.isclose(end[5:], other_end[5:]).any()
    assert np.array_equal(there(read.at(after).interval(0.9))[0], own[0][5:])


def test_frames_are_read_as_the_head_was_taught(run: Network):
    """Training has whole contacts at once, reading one frame after another."""
    estimate, head = answers(12), there(run.sequence)
    margin, ratio = (there(one.probabilities).astype("f4") for one in (estimate, there(estimate.ratio)))
    elapsed_s = np.array([1.0, *np.full(11, 0.1)])
    with torch.no_grad():
        told = torch.from_numpy(head.make_inputs(head.summarize(margin, ratio), elapsed_s))
        logits = head.logits(torch.from_numpy(margin)) + head(told)[0]
    read = run.follow().update(estimate, np.arange(12) / 10, np.ones(12, dtype=bool))
    # floats have 24 bits, and sums of up to 80 of them are added in another order
    np.testing.assert_allclose(read.margin, logits.softmax(-1).numpy() @ head.centres, atol=1e-5)


def test_a_recording_is_read_as_the_follower_reads_it(run: Network, small_dataset: Dataset, tmp_path: Path):
    info = small_dataset.trials[0]
    table = sl.predict(run, small_dataset, split="train", sequence=True).to_arrow()
    rows = table.filter(np.array([name == info.trial for name in table["trial"].to_pylist()]))
    trial = small_dataset.load(info)
    estimate = run.estimate(run.encode(trial.frames, trial.reference))
    touches = np.array([state != ContactState.NO_CONTACT for state in trial.contact_state])
    expected = run.follow().update(estimate, trial.time_s, touches)
    np.testing.assert_allclose(rows["prediction"].to_numpy(), expected.margin, atol=1e-5)
    low, _ = expected.interval(0.9) or pytest.fail("a taught head has intervals")
    np.testing.assert_allclose(rows["low_90"].to_numpy(), low, atol=1e-5)
    written = sl.predict(run, small_dataset, split="train", sequence=True, out=tmp_path / "margins").to_arrow()
    assert written["prediction"].equals(table["prediction"])


def test_what_cannot_be_followed_is_refused(run: Network, small_dataset: Dataset):
    with pytest.raises(InputError, match="--recipe sequence"):
        sl.predict("thesis-raw", small_dataset, sequence=True)
    with pytest.raises(InputError, match="leave out one of them"):
        sl.predict(run, small_dataset, sequence=True, friction=0.6)
    with pytest.raises(InputError, match="times"):
        sl.predict(run, small_dataset.load(small_dataset.trials[0]).frames, sequence=True)


def test_frames_that_come_too_seldom_are_refused(run: Network, small_dataset: Dataset):
    trials = small_dataset.select(split="test")
    [capture] = open_source(small_dataset, trial=trials[0].trial)
    seldom = replace(capture, frame_time_s=30 * there(capture.time_s))  # one a second
    with pytest.raises(InputError, match=r"has a frame each 1 s, .* leave out --sequence, or record 2 frames a second"):
        sl.predict(run, [seldom], sequence=True)
    assert len(sl.predict(run, [seldom])) == len(capture)
