import numpy as np
import pytest

from sliplens.training.data import EpochShuffle, EvenShares


def test_each_epoch_has_an_order_of_its_own_that_repeats():
    shuffle = EpochShuffle(20, seed=1)
    first = list(shuffle)
    shuffle.set_epoch(1)
    second = list(shuffle)
    shuffle.set_epoch(0)
    assert sorted(first) == sorted(second) == list(range(20))
    assert first != second
    assert list(shuffle) == first


@pytest.mark.parametrize(("count", "drawn"), [(20, 7), (7, 20), (5, 15)])
def test_an_epoch_may_draw_more_or_fewer_and_none_much_oftener_than_another(count: int, drawn: int):
    shuffle = EpochShuffle(count, seed=1, drawn=drawn)
    times = np.bincount(shuffle.order(2), minlength=count)
    assert len(shuffle) == times.sum() == drawn
    assert np.ptp(times) <= 1


@pytest.mark.parametrize(("count", "processes"), [(20, 1), (20, 2), (23, 2), (23, 4)])
def test_batches_of_all_processes_together_are_those_of_one(count: int, processes: int):
    share = 3
    alone = EpochShuffle(count, seed=1).order(4)
    parts = []
    for rank in range(processes):
        shuffle = EpochShuffle(count, seed=1, rank=rank, processes=processes)
        shuffle.set_epoch(4)
        parts.append(list(shuffle))
        assert len(parts[-1]) == len(shuffle) == count // processes  # as many steps in each
    for batch in range(count // processes // share):
        together = {row for part in parts for row in part[batch * share : (batch + 1) * share]}
        whole = share * processes
        assert together == set(alone[batch * whole : (batch + 1) * whole])


@pytest.mark.parametrize("count", [4, 5, 7, 63, 64, 65, 129])
@pytest.mark.parametrize("processes", [1, 2, 3, 4])
@pytest.mark.parametrize("batch_size", [2, 16])
def test_validation_counts_every_frame_once_in_as_many_steps_everywhere(count: int, processes: int, batch_size: int):
    shares = [EvenShares(count, batch_size=batch_size, rank=rank, processes=processes) for rank in range(processes)]
    assert sorted(row for share in shares for batch in share for row in batch) == list(range(count))
    assert len({len(share) for share in shares}) == 1
    assert all(0 < len(batch) <= batch_size for share in shares for batch in share)
