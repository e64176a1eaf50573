"""Where a network fails: planted faults, and answers whose slope is known."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run

import sliplens as sl
from sliplens.errors import InputError
from sliplens.intervals import Difference
from sliplens.recordings import Dataset
from sliplens.results.evaluation import ErrorSlice, ErrorTable
from sliplens.study.diagnose import excess_error, find_slices, hold_out, say_errors, say_slices

TRIALS, FRAMES = 40, 12


def table_of_errors(rng: np.random.Generator, **columns: np.ndarray) -> ErrorTable:
    """Half of the trials wet, friction and force drawn apart, errors of 0.05 either way."""
    count, trial = TRIALS * FRAMES, np.repeat(np.arange(TRIALS), FRAMES)
    margin = rng.random(count)
    made = {
        "trial": np.array([f"trial-{one:02d}" for one in trial]),
        "condition": np.where(trial % 2 == 0, "dry", "wet"),
        "sensor": np.full(count, "one"),
        "day": trial // 5 % 4 + 1,
        "frame": np.tile(np.arange(FRAMES), TRIALS),
        "safety_margin": margin,
        "prediction": margin + rng.normal(0, 0.05, count),
        # two in five trials slippery, and none near the border
        "friction": np.where(trial % 5 < 2, 0.3, 0.9) + np.repeat(rng.uniform(-0.1, 0.1, TRIALS), FRAMES),
        "normal_force_n": rng.uniform(0.5, 2.0, count),
        "contact_x": rng.uniform(0.4, 0.6, count),
        "contact_y": np.full(count, np.nan),
        "slice": np.full(count, -1),
        "withheld": np.full(count, ""),
        **dict.fromkeys(("time_s", "sigma", "low_90", "high_90"), np.full(count, np.nan)),
    }
    return ErrorTable(**{**made, **columns})


@pytest.fixture
def errors(rng) -> ErrorTable:
    return table_of_errors(rng)


def test_a_fault_of_all_trials_is_found_and_one_of_the_training_half_is_not(errors):
    slippery = errors.friction < 0.5
    held = hold_out(errors, seed=3)
    # each half has trials of each condition
    assert {name: held[errors.condition == name].mean() for name in ("dry", "wet")} == {"dry": 0.5, "wet": 0.5}
    everywhere = replace(errors, prediction=errors.prediction + 0.4 * slippery)
    slices, found = find_slices(everywhere, seed=3)
    bad = [at for at, one in enumerate(slices) if one.holds]
    assert bad
    assert slices[0].holds
    assert all("friction up to" in slices[at].name for at in bad)
    np.testing.assert_array_equal(np.isin(found.slice, bad), slippery)
    assert slices[0].bias == pytest.approx(0.4, abs=0.05)
    assert slices[0].name in say_slices(slices)

    once = replace(errors, prediction=errors.prediction + 0.4 * (slippery & ~held))
    slices, found = find_slices(once, seed=3)
    assert "friction up to" in slices[int(found.slice[slippery][0])].name  # the tree has learned it
    assert not any(one.holds for one in slices)
    assert say_slices(slices).startswith("No slice")

    # half of a few trials tests nothing
    few = everywhere.where(np.isin(everywhere.trial, [f"trial-{one:02d}" for one in range(8)]))
    assert say_slices(find_slices(few, seed=3)[0]).startswith("Where the error is larger is not known")
    assert say_slices(()) == say_slices(find_slices(few, seed=3)[0])


def test_slices_are_named_for_what_their_frames_have_in_common(errors, rng):
    wet = replace(errors, prediction=errors.prediction + 0.5 * (errors.condition == "wet"))
    slices, found = find_slices(wet, seed=0)
    for at, one in enumerate(slices):
        own = found.where(found.slice == at)
        assert one.name.startswith(f"{own.condition[0]} objects")
        assert len(set(own.condition.tolist())) == 1
        # what is not known of all frames, or is the same in all, tells nothing
        assert "top" not in one.name
        assert "sensor" not in one.name
    assert "Wet less dry: +4" in say_errors(wet, rng)
    tested = found.where(hold_out(found, seed=0) & (found.slice == 0))
    assert (slices[0].frames, slices[0].error) == (len(tested), pytest.approx(np.abs(tested.error).mean()))


def test_a_group_is_compared_with_the_rest_as_trials_drawn_again_do(errors, rng):
    inside = errors.friction < 0.5
    planted = replace(errors, prediction=errors.prediction + np.repeat(rng.normal(0, 0.1, TRIALS), FRAMES) * inside)
    gap, sizes = excess_error(planted, inside, rng), np.abs(planted.error)
    assert gap.estimate == pytest.approx(sizes[inside].mean() - sizes[~inside].mean())
    # one day alone: else the interval is over days
    gap = excess_error(replace(planted, day=np.ones(len(planted), dtype=np.int64)), inside, rng)
    drawn = []
    for _ in range(1000):
        rows = np.concatenate([at * FRAMES + np.arange(FRAMES) for at in rng.integers(0, TRIALS, TRIALS)])
        drawn.append(sizes[rows][inside[rows]].mean() - sizes[rows][~inside[rows]].mean())
    low, high = np.quantile(drawn, [0.025, 0.975])
    # two ways to draw: alike within a fourth of their width
    assert (gap.low, gap.high) == pytest.approx((low, high), abs=0.25 * (high - low))
    assert excess_error(errors, np.ones(len(errors), dtype=bool), rng).estimate == 0


def test_a_diagnosis_is_kept_and_drawn(difference_run: Path, fine_dataset: Dataset, tmp_path):
    found = sl.diagnose(difference_run, fine_dataset, tmp_path)
    assert np.isfinite(found.errors.error).all()
    # few trials have no half to test a slice on
    excess = Difference(estimate=0.1, low=0.05, high=0.15, units=6)
    slippery = ErrorSlice(name="wet objects", frames=12, trials=6, error=0.2, bias=0.1, excess=excess)
    (ax,) = sl.plot(replace(found, slices=(slippery,))).axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["wet objects"]
    assert ax.lines[0].get_xdata() == pytest.approx([5, 15])  # percentage points
    assert sl.diagnose(difference_run, fine_dataset, tmp_path).sentences == found.sentences


def test_what_is_missing_is_refused(difference_run, fine_dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(InputError, match=r'needs sklearn, which is not installed; .*"sliplens\[diagnose\]"'):
        sl.diagnose(difference_run, fine_dataset)


def test_the_command_says_what_was_found_and_draws_the_page(difference_run, fine_dataset, tmp_path, capsys):
    assert run("diagnose", difference_run, fine_dataset.folder, "-o", tmp_path / "runs") == 0
    captured = capsys.readouterr()
    said = " ".join((captured.out + captured.err).split())
    assert "the answer is off by" in said
    assert (tmp_path / "runs" / "report.html").is_file()
