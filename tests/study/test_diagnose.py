"""Where a network fails: planted faults, and answers whose slope is known."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import run
from torch import Tensor, nn

import sliplens as sl
from sliplens.errors import InputError
from sliplens.files import output_folder
from sliplens.intervals import Difference
from sliplens.models import Manifest, Network
from sliplens.recordings import Dataset, load_dataset
from sliplens.results.evaluation import ErrorSlice, ErrorTable, FrictionTable
from sliplens.simulation import SimulationRecipe, simulate_dataset
from sliplens.study import diagnose as diagnosing
from sliplens.study.diagnose import (
    excess_error,
    find_slices,
    friction_slopes,
    hold_out,
    say_errors,
    say_limits,
    say_slices,
    say_slope,
)

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
        **dict.fromkeys(("time_s", "sigma", "low_90", "high_90", "limit"), np.full(count, np.nan)),
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
    assert "same friction" in say_errors(wet, rng)
    assert "same friction" not in say_errors(replace(wet, friction=np.where(wet.condition == "wet", 0.3, 0.9)), rng)
    tested = found.where(hold_out(found, seed=0) & (found.slice == 0))
    assert (slices[0].frames, slices[0].error) == (len(tested), pytest.approx(np.abs(tested.error).mean()))


def test_wet_objects_that_are_slippery_alone_are_no_worse_than_dry_ones_of_their_friction(rng):
    trial = np.repeat(np.arange(TRIALS), FRAMES)
    # wet and dry meet between 0.5 and 0.7; below it the margin is read too high, whatever the object
    friction = np.where(trial % 2 == 0, 0.5 + 0.02 * trial, 0.1 + 0.015 * trial)
    margin = rng.random(len(trial))
    wrong = 0.4 * (friction < 0.5) + rng.normal(0, 0.05, len(trial))
    said = say_errors(table_of_errors(rng, friction=friction, safety_margin=margin, prediction=margin + wrong), rng)
    first, alike = said.split("Among objects of the same friction, 0.50 to 0.68")
    assert "which may be chance" not in first
    assert "which may be chance" in alike


def test_an_error_is_held_against_what_the_picture_leaves_open(errors, rng):
    for limit, verdict in ((0.05, "not told from"), (0.02, "above"), (0.12, "below")):
        dry, wet = say_limits(replace(errors, limit=np.full(len(errors), limit)), rng)
        assert f"It is {verdict} the {100 * limit:.1f} points" in dry
        assert wet.startswith("On wet objects the root mean squared error in 240 frames of 20 trials is ")
    assert say_limits(errors, rng) == []


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


def frictions(slope: float, best: float, *, trials: int = 12) -> FrictionTable:
    """Frames of trials whose answers lie on lines, at other margins in each."""
    margins = np.concatenate([np.array([0.6, 0.2, 0.4]) + 0.01 * trial for trial in range(trials)])
    trial = np.repeat(np.arange(trials), 3)
    return FrictionTable(
        frame_id=np.array([f"frame-{one}" for one in trial]),
        trial=np.array([f"trial-{one}" for one in trial]),
        condition=np.full(len(trial), "wet"),
        day=np.ones(len(trial), dtype=np.int64),
        friction=0.5 / (1 - margins),
        safety_margin=margins,
        prediction=0.1 * np.sin(trial) + slope * margins + 1e-3 * np.cos(7 * margins),
        reading_slope=np.full(len(trial), best),
    )


@pytest.mark.parametrize(
    ("slope", "best", "verdict"), [(0.1, 0.4, "less than"), (0.6, 0.4, "more than"), (0.4, 0.4, "not told from")]
)
def test_a_slope_is_that_of_the_line_the_answers_lie_on(slope, best, verdict, rng):
    (found,) = friction_slopes(frictions(slope, best), rng)
    # the ripple that keeps the lines apart has a slope of 0.007 at most
    assert found.network.estimate == pytest.approx(slope, abs=0.007)
    assert found.reading.estimate == pytest.approx(best)
    assert found.gap.estimate == pytest.approx(found.network.estimate - best)
    if slope == best:
        found = replace(found, gap=replace(found.gap, low=-0.01, high=0.01))
    sentence = say_slope(found)
    assert f"{verdict} that of the best reading" in sentence
    assert f"{found.network.estimate:+.2f}" in sentence


class Brightness(nn.Module):
    """Sum of the input with a weight for each pixel: contributions add up exactly."""

    def __init__(self) -> None:
        super().__init__()
        across = torch.linspace(0, 1e-3, 56)
        self.weight = nn.Parameter(across.expand(1, 3, 56, 56).clone())

    def forward(self, images: Tensor) -> Tensor:
        return (images * self.weight).sum(dim=(1, 2, 3))[:, None]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> tuple[Network, Dataset]:
    recipe = SimulationRecipe(dry_trials=3, wet_trials=0, frames_per_trial=20, seed=6)
    folder = tmp_path_factory.mktemp("simulated") / "data"
    with output_folder(folder, stage="simulate", config={"recipe": recipe}) as out:
        simulate_dataset(out.folder, recipe)
    manifest = Manifest(
        backbone="none", input="amplitude", image_size=56, frame_size=(224, 224), sensor="chromatouch",
        data_hash="none", weights_sha256="of these weights",
    )  # fmt: skip
    return Network(model=Brightness().eval(), manifest=manifest), load_dataset(folder)


def test_simulated_frames_are_explained_and_filmed_anew(simulated, tmp_path, monkeypatch):
    network, data = simulated
    monkeypatch.setattr(diagnosing, "LEVELS", (0.5,))
    found = sl.diagnose(network, data, tmp_path, trials=1)
    assert found.left_out == ""
    assert (found.errors.limit > 0).sum() == 1
    for own in found.frictions.groups("frame_id").values():
        # the forces stay: 1 - margin is inverse to the friction
        np.testing.assert_allclose((1 - own.safety_margin) * own.friction, (1 - own.safety_margin[0]) * own.friction[0])
        # among them is the frame as it was, with the answer that it had
        trial, frame = own.frame_id[0].rsplit("-f", 1)
        rows = (found.errors.trial == trial) & (found.errors.frame == int(frame))
        at = np.abs(own.safety_margin - found.errors.safety_margin[rows]).argmin()
        assert own.prediction[at] == pytest.approx(found.errors.prediction[rows][0], abs=1e-6)
    # the middle of the contact, as the labels' map has it
    recording = data.load(data.find(str(found.errors.trial[0])))
    assert recording.truth is not None
    rows, columns = np.nonzero(recording.truth.contact_map[found.errors.frame[0]])
    assert found.errors.contact_x[0] == pytest.approx((columns.mean() + 0.5) / 224)
    assert found.errors.contact_y[0] == pytest.approx((rows.mean() + 0.5) / 224)
    # one trial has no half to test a slice on
    with pytest.raises(InputError, match="tested no slice of the trials"):
        sl.plot(found)
    excess = Difference(estimate=0.1, low=0.05, high=0.15, units=6)
    slippery = ErrorSlice(name="wet objects", frames=12, trials=6, error=0.2, bias=0.1, excess=excess)
    (ax,) = sl.plot(replace(found, slices=(slippery,))).axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["wet objects"]
    assert ax.lines[0].get_xdata() == pytest.approx([5, 15])  # percentage points
    # kept: the same call reads it
    monkeypatch.setattr(diagnosing, "refilm", None)
    assert sl.diagnose(network, data, tmp_path, trials=1).sentences == found.sentences
    page = sl.write_report(tmp_path).page.read_text(encoding="utf-8")
    assert "Where the network fails" in page
    assert "friction alone" in page


def test_recordings_say_what_is_left_out(difference_run: Path, fine_dataset: Dataset, tmp_path):
    found = sl.diagnose(difference_run, fine_dataset, tmp_path, trials=2)
    assert "known of simulated frames alone" in found.left_out
    assert len(found.frictions) == len(found.slopes) == 0
    assert np.isnan(found.errors.limit).all()
    assert found.left_out.rstrip(".") in sl.write_report(tmp_path).page.read_text(encoding="utf-8")


def test_what_is_missing_or_impossible_is_refused(difference_run, fine_dataset, monkeypatch):
    with pytest.raises(InputError, match="--trials must be at least 1"):
        sl.diagnose(difference_run, fine_dataset, trials=0)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(InputError, match=r'needs sklearn, which is not installed; .*"sliplens\[diagnose\]"'):
        sl.diagnose(difference_run, fine_dataset)


def test_the_command_says_what_was_found_and_draws_the_page(difference_run, fine_dataset, tmp_path, capsys):
    assert run("diagnose", difference_run, fine_dataset.folder, "-o", tmp_path / "runs", "--trials", 1) == 0
    captured = capsys.readouterr()
    said = " ".join((captured.out + captured.err).split())
    assert "the answer is off by" in said
    assert "are left out" in said
    assert (tmp_path / "runs" / "report.html").is_file()
