"""Networks that come with the package: their weights are rounded, and their answers stay."""

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from data_sets import contents
from small import TRACTION, save_untrained

from sliplens.errors import InputError
from sliplens.models import load, save_checkpoint
from sliplens.recordings import Dataset

CI = Path(__file__).parents[1] / ".ci"
SHIP = SimpleNamespace(**runpy.run_path(str(CI / "ship.py")))
AVERAGE = SimpleNamespace(**runpy.run_path(str(CI / "average.py")))
HEADS = {"margin", "ratio", "margin told 0.3", "margin told 0.6", "margin told 0.9"}


@pytest.mark.parametrize("bits", [11, 13, 22])
def test_a_weight_moves_by_half_of_its_last_bit_at_most(bits: int):
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(40, 50)).astype(np.float32))
    kept = SHIP.rounded(weights, bits=bits)
    assert not (kept.numpy().view(np.uint32) & ((1 << (23 - bits)) - 1)).any()
    _, exponent = np.frexp(weights.numpy())  # of a fraction in [1/2, 1)
    assert (np.abs((kept - weights).numpy()) <= np.ldexp(0.5, exponent - 1 - bits)).all()
    assert torch.equal(SHIP.rounded(kept, bits=bits), kept)
    # 1 + 2^-bits is kept, and what lies halfway goes to the even one
    steps = torch.tensor([1.0, 0.5, 1.5]) * 2.0**-bits
    assert torch.equal(SHIP.rounded(1 + steps, bits=bits), 1 + torch.tensor([1.0, 0.0, 2.0]) * 2.0**-bits)


def test_ten_bits_are_stored_as_half_precision_and_counts_stay():
    weights, count = torch.tensor([0.1, -3.0]), torch.tensor(7)
    assert torch.equal(SHIP.rounded(weights, bits=10), torch.tensor([0.1, -3.0], dtype=torch.float16))
    assert SHIP.rounded(count, bits=10) is count


@pytest.fixture
def run(small_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A network with all heads, asked about one small trial."""
    trials = [small_dataset.load(small_dataset.trials[0])]
    monkeypatch.setitem(SHIP.ship.__globals__, "simulate", lambda: trials)
    folder = save_untrained(tmp_path / "run", traction=TRACTION)
    for name in ("run.json", "result.json"):
        (folder / name).write_text(name)
    return folder


def test_answers_of_every_head_move_by_what_is_said(run: Path, small_dataset: Dataset, tmp_path: Path):
    changes = SHIP.ship(run, tmp_path / "shipped", bits=20)
    assert set(changes) == HEADS
    trials = [small_dataset.load(small_dataset.trials[0])]
    before, after = (SHIP.read(load(folder), trials) for folder in (run, tmp_path / "shipped"))
    for name, change in changes.items():
        assert 0 < change < SHIP.LARGEST_CHANGE
        assert np.abs(after[name] - before[name]).max() == pytest.approx(change)
    assert {path.name: path.read_text() for path in (tmp_path / "shipped").glob("r*.json")} == {
        "run.json": "run.json",
        "result.json": "result.json",
    }


def test_a_network_whose_answers_would_move_far_is_refused_and_nothing_is_written(run: Path, tmp_path: Path):
    with pytest.raises(SystemExit, match=r"answers move too far \(margin .*keep more bits; nothing was written"):
        SHIP.ship(run, tmp_path / "shipped", bits=4)
    assert not (tmp_path / "shipped").exists()


@pytest.fixture
def two_runs(tmp_path: Path) -> list[Path]:
    """Two networks that were trained further from the same one, and the weights of one of them moved."""
    folders = []
    for name, moved in (("one", 0.0), ("other", 0.25)):
        network = load(save_untrained(tmp_path / f"from-{name}", traction=TRACTION))
        state = {
            key: value + moved if value.is_floating_point() and key.endswith("weight") else value
            for key, value in network.model.state_dict().items()
        }
        network.model.load_state_dict(state)
        (folder := tmp_path / name).mkdir()
        save_checkpoint(folder, network.model, replace(network.manifest, started_from="ab"))
        folders.append(folder)
    return folders


def test_each_weight_of_an_average_lies_halfway(two_runs: list[Path], small_dataset: Dataset, tmp_path: Path):
    AVERAGE.average(small_dataset.folder, two_runs, tmp_path / "average")
    states = [load(folder).model.state_dict() for folder in (*two_runs, tmp_path / "average")]
    for name, value in states[2].items():
        if "temperature" not in name:  # which is fitted anew
            assert torch.allclose(2 * value.double(), states[0][name].double() + states[1][name].double(), rtol=1e-6)


def test_an_average_is_made_once_of_the_same_networks(two_runs: list[Path], small_dataset: Dataset, tmp_path: Path):
    error = AVERAGE.average(small_dataset.folder, two_runs, tmp_path / "average")
    before = contents(tmp_path / "average")
    assert AVERAGE.average(small_dataset.folder, two_runs, tmp_path / "average") == error
    assert contents(tmp_path / "average") == before
    with pytest.raises(InputError):
        AVERAGE.average(small_dataset.folder, two_runs[::-1], tmp_path / "average")


def test_networks_that_did_not_begin_alike_are_not_averaged(
    two_runs: list[Path], small_dataset: Dataset, tmp_path: Path
):
    one = load(two_runs[0])
    for begun in ("", "cd"):  # random weights, and those of another network
        save_checkpoint(two_runs[0], one.model, replace(one.manifest, started_from=begun))
        with pytest.raises(SystemExit, match="trained further from the same one"):
            AVERAGE.average(small_dataset.folder, two_runs, tmp_path / "average")
    assert not (tmp_path / "average").exists()
