"""Wall-clock time of work that may run on another device."""

import time

import torch
from torch import Tensor


class Clock:
    """Started when made; `seconds` waits for the device of a result before it reads."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def seconds(self, result: Tensor) -> float:
        """Seconds since the start, with the work that led to `result` finished."""
        if result.is_cuda:
            torch.cuda.synchronize(result.device)
        return time.perf_counter() - self._start
