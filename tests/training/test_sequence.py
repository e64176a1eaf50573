"""Teaching a network to read several frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small import TRACTION, save_untrained
from there import there

from sliplens.errors import InputError, ModelError
from sliplens.models import load
from sliplens.models.sequence import GAP_S
from sliplens.recordings import Dataset
from sliplens.training import evaluate, train
from sliplens.training.sequence import TrialOutputs


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_untrained(tmp_path_factory.mktemp("start") / "run", traction=TRACTION)


def teach(data: Dataset, start: Path, out: Path | None = None, **changes):
    return train(data, out, recipe="sequence", start_from=start, **{"epochs": 150, "learning_rate": 1e-2} | changes)


def test_several_frames_tell_what_one_does_not(small_dataset: Dataset, start: Path, tmp_path: Path):
    """The margin of these trials falls with time: a network of random weights does not see it, its head counts."""
    run = teach(small_dataset, start, tmp_path / "run")
    kept, before, training = run.manifest.sequence, load(start), run.training
    assert kept is not None
    assert training is not None
    assert kept.calibration.mse < 0.7 * kept.mse_one
    for name, values in run.model.state_dict().items():
        assert torch.equal(values, before.model.state_dict()[name])
    assert run.manifest.calibration == before.manifest.calibration
    assert training.curve.validation_mse.min() == pytest.approx(training.best_validation_mse)
    assert {one.sha256[:12] for one in small_dataset.trials if one.split != "test"} == set(run.manifest.trained_on)


def test_neither_rate_nor_number_of_frames_tells_how_long_a_trial_is(rng: np.random.Generator):
    """Trials of equally many frames: their own rates differ fivefold, those that teach do not depend on the trial."""
    rates = {}
    for duration_s in (1.5, 7.5):
        time_s = np.linspace(0, duration_s, 76)
        trial = TrialOutputs(margin=np.zeros((76, 1), "f4"), ratio=np.zeros((76, 1), "f4"), label=time_s, time_s=time_s)
        some = [trial.sample(rng) for _ in range(400)]
        assert all(one.time_s[0] <= duration_s / 2 + 0.1 for one in some)
        assert all(np.array_equal(one.label, one.time_s) for one in some)
        rates[duration_s] = np.concatenate([np.diff(one.time_s)[:1] for one in some])
        assert rates[duration_s].min() >= 0.1 - 1e-6
    # the step is a multiple of the time between frames, 0.02 or 0.1 s, which rounds it up by half of that on average
    assert rates[7.5].mean() - rates[1.5].mean() == pytest.approx(0.04, abs=0.03)


def test_no_step_is_taught_that_is_never_read(rng: np.random.Generator):
    """Every second frame, 0.7 s apart, would be further than memory reaches when a trial is read."""
    time_s = 0.35 * np.arange(20)
    empty = np.zeros((20, 1), "f4")
    trial = TrialOutputs(margin=empty, ratio=empty, label=time_s, time_s=time_s)
    steps = [np.diff(trial.sample(rng).time_s) for _ in range(50)]
    assert np.concatenate(steps).max() <= GAP_S
    assert np.allclose(np.concatenate(steps), 0.35)


def test_a_trial_is_taught_and_read_up_to_its_first_gap(small_dataset: Dataset, start: Path, monkeypatch):
    load = Dataset.load
    times = np.where(np.arange(12) < 7, 0.0, 30.0) + 0.1 * np.arange(12)
    monkeypatch.setattr(Dataset, "load", lambda *args, **named: replace(load(*args, **named), time_s=times))
    run = teach(small_dataset, start, epochs=20)
    assert there(run.training).validation_frames == 2 * 6  # the first of 7 has no label
    in_order, alone = (
        evaluate(run, small_dataset, split="validation", sequence=one).predictions for one in (True, False)
    )
    before = in_order.frame < 7
    errors = in_order.prediction[before] - in_order.safety_margin[before]
    # the error that the manifest tells is that of the trials as they are read, but for single precision
    assert np.mean(errors**2) == pytest.approx(there(run.manifest.sequence).calibration.mse, rel=1e-4)
    assert np.array_equal(in_order.prediction[~before], alone.prediction[~before])
    assert np.abs(in_order.prediction - alone.prediction)[before].min() > 1e-3


def test_what_cannot_be_taught_is_refused(small_dataset: Dataset, start: Path, difference_run: Path):
    with pytest.raises(InputError, match="--start-from"):
        train(small_dataset, recipe="sequence")
    with pytest.raises((InputError, ModelError), match="ratio"):
        teach(small_dataset, difference_run)
    with pytest.raises(InputError, match="leave out --image-size"):
        teach(small_dataset, start, image_size=96)
    with pytest.raises(InputError, match="--logger"):
        teach(small_dataset, start, logger="tensorboard")
    with pytest.raises(ModelError, match="has the input difference, and pair is to be trained"):
        teach(small_dataset, start, input="pair")
