import pytest

from sliplens.errors import InputError
from sliplens.training import TrainingConfig, make_trainer
from sliplens.training.module import share_of_batch


def test_a_process_has_its_number_before_it_trains(monkeypatch: pytest.MonkeyPatch):
    for name in ("RANK", "LOCAL_RANK", "NODE_RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID", "SLURM_NTASKS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NODE_RANK", "1")
    monkeypatch.setenv("LOCAL_RANK", "1")
    trainer = make_trainer(TrainingConfig(), accelerator="cpu", devices=2, num_nodes=2)
    assert (trainer.global_rank, trainer.world_size) == (3, 4)


def test_a_batch_is_shared_evenly_or_refused_with_the_next_that_is():
    assert [share_of_batch(24, processes) for processes in (1, 3, 12)] == [24, 8, 2]
    for batch_size, cure in ((64, 63), (2, 6), (3, 6)):
        with pytest.raises(InputError, match=f"batch_size {batch_size} does not divide .* choose {cure}"):
            share_of_batch(batch_size, 3)


def test_no_hardware_is_refused():
    with pytest.raises(InputError, match=r"this machine cannot train on 0 x cpu .*change --devices"):
        make_trainer(TrainingConfig(), accelerator="cpu", devices=0)
