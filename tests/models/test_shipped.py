from pathlib import Path

import pytest

import sliplens
from sliplens.errors import InputError
from sliplens.models.shipped import find_run, shipped_names


def test_every_network_of_the_package_loads_and_says_what_it_learned_from():
    for name in shipped_names():
        trained = sliplens.load(name)
        assert not trained.model.training
        assert trained.manifest.data_hash
        assert trained.manifest.metrics
        assert find_run(Path(name)).name == name


def test_a_network_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="no network named 'gelsight' comes with sliplens; choose"):
        sliplens.load("gelsight")
    with pytest.raises(InputError, match="the run nowhere does not exist; check the path"):
        find_run(Path("nowhere"))


def test_a_folder_counts_before_a_network_of_the_package(difference_run: Path):
    assert find_run(difference_run) == difference_run


def test_nothing_else_is_found_by_asking_the_package():
    with pytest.raises(AttributeError, match="has no attribute 'weights_of_the_world'"):
        _ = sliplens.weights_of_the_world  # pyright: ignore[reportAttributeAccessIssue]
