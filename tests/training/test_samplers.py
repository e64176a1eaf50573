import numpy as np
import pytest

from sliplens.training.data import EpochShuffle, even_shares


def order(epoch: int, count: int, **options: int) -> list[int]:
    shuffle = EpochShuffle(count, seed=1, **options)
    shuffle.set_epoch(epoch)
    assert len(list(shuffle)) == len(shuffle)
    return list(shuffle)


@pytest.mark.parametrize(("count", "drawn"), [(20, 20), (20, 7), (7, 20), (5, 15)])
def test_each_epoch_has_an_order_that_repeats_and_draws_all_frames_alike(count: int, drawn: int):
    assert order(2, count, drawn=drawn) == order(2, count, drawn=drawn) != order(3, count, drawn=drawn)
    times = np.bincount(order(2, count, drawn=drawn), minlength=count)
    assert times.sum() == drawn
    assert np.ptp(times) <= 1


@pytest.mark.parametrize(("count", "processes"), [(20, 2), (23, 2), (23, 4)])
def test_batches_of_all_processes_together_are_those_of_one(count: int, processes: int):
    alone = order(4, count)
    parts = [order(4, count, rank=rank, processes=processes) for rank in range(processes)]
    for end in range(1, count // processes + 1):
        assert {row for part in parts for row in part[:end]} == set(alone[: end * processes])


@pytest.mark.parametrize("count", [4, 7, 64, 65, 129])
@pytest.mark.parametrize("processes", [1, 3, 4])
def test_validation_counts_every_frame_once_in_as_many_steps_everywhere(count: int, processes: int):
    shares = [even_shares(count, batch_size=16, rank=rank, processes=processes) for rank in range(processes)]
    assert sorted(row for share in shares for batch in share for row in batch) == list(range(count))
    assert len({len(share) for share in shares}) == 1
    assert all(0 < len(batch) <= 16 for share in shares for batch in share)
