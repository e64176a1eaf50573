import numpy as np
import pytest

from sliplens.training.data import EpochShuffle


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
