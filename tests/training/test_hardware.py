from pathlib import Path

import pytest

from sliplens.errors import InputError
from sliplens.files import output_folder
from sliplens.training.hardware import Hardware, follow_folder

VARIABLES = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID")
VARIABLES += ("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_JOB_NAME")


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
        ({"SLURM_NTASKS": "4", "SLURM_NTASKS_PER_NODE": "2", "SLURM_JOB_NAME": "train", "SLURM_PROCID": "2"}, 2),
    ],
)
def test_a_process_knows_its_number_before_it_trains(
    variables: dict[str, str], rank: int, monkeypatch: pytest.MonkeyPatch
):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert Hardware(devices=2, num_nodes=2).rank() == rank


def test_a_cluster_that_lightning_cannot_read_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SLURM_NTASKS", "4")
    with pytest.raises(InputError, match=r"cannot tell the processes of this cluster apart .*ntasks-per-node"):
        Hardware(devices=4).rank()


def test_processes_that_nobody_asked_for_are_refused(monkeypatch: pytest.MonkeyPatch):
    for name, value in {"TORCHELASTIC_RUN_ID": "a", "RANK": "1", "LOCAL_RANK": "1", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match="2 processes were started, but --devices times --num-nodes is 1; make them"):
        Hardware().rank()


@pytest.mark.parametrize("devices", [1, 2, 3, 4, 6])
def test_the_shares_of_a_batch_make_the_batch(devices: int):
    hardware = Hardware(devices=devices, num_nodes=2)
    assert hardware.share(24) * hardware.processes == 24


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
        Hardware(devices=3).share(batch_size)


def test_no_hardware_is_refused():
    with pytest.raises(InputError, match="devices must be at least 1, got 0"):
        Hardware(devices=0)
    with pytest.raises(InputError, match="num_nodes must be at least 1, got -1"):
        Hardware(num_nodes=-1)


def test_the_others_find_the_folder_of_the_first_and_touch_nothing(tmp_path: Path):
    target = tmp_path / "run"
    expected = follow_folder(target)
    assert list(tmp_path.iterdir()) == []
    with output_folder(target, stage="train", config={}) as out:
        assert follow_folder(target) == expected == out.folder
    assert follow_folder(target) is None  # nothing to do
    assert follow_folder(target, overwrite=True) == expected
