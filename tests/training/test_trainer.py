import pytest

from sliplens.errors import InputError
from sliplens.training import TrainingConfig, make_trainer
from sliplens.training.module import share_of_batch

VARIABLES = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID")
SECOND_NODE = {"SLURM_PROCID": "2", "SLURM_NODEID": "1", "SLURM_LOCALID": "0"}
VARIABLES += ("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_JOB_NAME", *SECOND_NODE)


@pytest.fixture(autouse=True)
def _no_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    ("variables", "rank"),
    [
        ({}, 0),
        # a child that Lightning started on the first machine, then the one that a user started on the second
        ({"LOCAL_RANK": "1"}, 1),
        ({"NODE_RANK": "1"}, 2),
        ({"NODE_RANK": "1", "LOCAL_RANK": "1"}, 3),
        ({"TORCHELASTIC_RUN_ID": "a", "RANK": "3", "LOCAL_RANK": "1", "WORLD_SIZE": "4"}, 3),
        (
            {
                "SLURM_NTASKS": "4",
                "SLURM_NTASKS_PER_NODE": "2",
                "SLURM_JOB_NAME": "train",
                "SLURM_PROCID": "2",
                "SLURM_NODEID": "1",
                "SLURM_LOCALID": "0",
            },
            2,
        ),
    ],
)
def test_a_process_knows_its_number_before_it_trains(
    variables: dict[str, str], rank: int, monkeypatch: pytest.MonkeyPatch
):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    trainer = make_trainer(TrainingConfig(), accelerator="cpu", devices=2, num_nodes=2)
    assert (trainer.global_rank, trainer.world_size) == (rank, 4)


def test_a_cluster_that_lightning_cannot_read_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SLURM_NTASKS", "4")
    with pytest.raises(InputError, match=r"this machine cannot train on 4 x cpu .*ntasks-per-node"):
        make_trainer(TrainingConfig(), accelerator="cpu", devices=4)


def test_processes_that_nobody_asked_for_are_refused(monkeypatch: pytest.MonkeyPatch):
    for name, value in {"TORCHELASTIC_RUN_ID": "a", "RANK": "1", "LOCAL_RANK": "1", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match=r"does not match the world size \(2\)\); change --devices, --num-nodes"):
        make_trainer(TrainingConfig(), accelerator="cpu")


@pytest.mark.parametrize("processes", [1, 2, 3, 4, 6, 12])
def test_the_shares_of_a_batch_make_the_batch(processes: int):
    assert share_of_batch(24, processes) * processes == 24


@pytest.mark.parametrize(
    ("batch_size", "message"),
    [
        (64, "batch_size 64 does not divide among 3 processes; choose 63"),
        (2, "batch_size 2 does not divide among 3 processes; choose 6"),
        (3, "batch_size 3 leaves one image to each of 3 processes, .*; choose 6 or more"),
    ],
)
def test_a_batch_that_cannot_be_shared_is_refused(batch_size: int, message: str):
    with pytest.raises(InputError, match=message):
        share_of_batch(batch_size, 3)


@pytest.mark.parametrize("flags", [{"devices": 0}, {"devices": 1, "num_nodes": 0}])
def test_no_hardware_is_refused(flags: dict[str, int]):
    with pytest.raises(InputError, match="this machine cannot train on"):
        make_trainer(TrainingConfig(), accelerator="cpu", **flags)
