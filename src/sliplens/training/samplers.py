"""Which frames make a batch, in one process or shared among several."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Sampler

from sliplens.datasets import FrameSet


class EpochShuffle(Sampler[int]):
    """A random order for each epoch that depends on the seed and the epoch alone, so that resuming repeats it.

    Of one order that all processes draw alike, each takes every `processes`-th frame, so that together the n-th batches
    of all processes are the n-th batch of one.

    Parameters
    ----------
    count
        Frames there are; those that do not divide among the processes are left out of this epoch.
    seed
        Of the orders.
    rank, processes
        Number of this process, from 0, and how many there are.
    """

    def __init__(self, count: int, *, seed: int, rank: int = 0, processes: int = 1) -> None:
        self.count = count
        self.seed = seed
        self.rank = rank
        self.processes = processes
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning calls this before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Count the frames of this process."""
        return self.count // self.processes

    def __iter__(self) -> Iterator[int]:
        """Yield every index once, over all processes."""
        return iter(self.order(self.epoch)[self.rank :: self.processes][: len(self)])

    def order(self, epoch: int) -> list[int]:
        """Every index once, in the order of an epoch."""
        return np.random.default_rng((self.seed, epoch)).permutation(self.count).tolist()


class EvenShares(Sampler[list[int]]):
    """Batches of every frame once, over all processes, and as many in each: they must take each step together.

    Parameters
    ----------
    count
        Frames there are, at least one for each process.
    batch_size
        Most frames of a batch.
    rank, processes
        Number of this process, from 0, and how many there are.
    """

    def __init__(self, count: int, *, batch_size: int, rank: int = 0, processes: int = 1) -> None:
        largest_share = -(-count // processes)
        rows = np.arange(count)[rank::processes]
        # shares differ by one frame at most, so that none of these is empty
        self.batches = [part.tolist() for part in np.array_split(rows, -(-largest_share // batch_size))]

    def __len__(self) -> int:
        """Count the batches, the same in every process."""
        return len(self.batches)

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the batches of this process."""
        return iter(self.batches)


def make_loaders(
    train: FrameSet, validation: FrameSet, *, seed: int, batch_size: int, rank: int, processes: int
) -> tuple[DataLoader, DataLoader]:
    """Loaders of this process; `batch_size` is its share of the batch."""
    common: dict[str, Any] = {"collate_fn": _as_is}
    shuffle = EpochShuffle(len(train), seed=seed, rank=rank, processes=processes)
    shares = EvenShares(len(validation), batch_size=batch_size, rank=rank, processes=processes)
    # a last small batch would make batch normalisation noisy
    shuffled = DataLoader(train, sampler=shuffle, batch_size=batch_size, drop_last=True, **common)
    return shuffled, DataLoader(validation, batch_sampler=shares, **common)


def _as_is(batch: Any) -> Any:
    return batch  # FrameSet.__getitems__ has made the batch already
