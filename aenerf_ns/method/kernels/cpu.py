"""Shared by the kernels for CPUs: the way numba compiles kernels, and the threads that run kernels.

The kernels release Python's lock and run on a pool of this module's own. Numba's own threads die when two Python
threads enter them at once, as the viewer and the training do.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba
import torch
from torch import Tensor

# Contraction is the only freedom from IEEE arithmetic: values that are not finite must stay so.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


def as_array(tensor: Tensor | None) -> Any:
    """Return the tensor's values as an array. Numba compiles a kernel of its own for None."""
    return None if tensor is None else tensor.detach().numpy()


def run_ranges(function: Callable[[int, int], None], length: int, block: int) -> None:
    """Call the function for as many ranges of ``length`` items as torch uses threads; each begins at a whole block."""
    num_blocks = -(-length // block)
    num_ranges = max(min(torch.get_num_threads(), num_blocks), 1)
    ends = [num_blocks * i // num_ranges * block for i in range(num_ranges + 1)]
    run(lambda i: function(ends[i], min(ends[i + 1], length)), range(num_ranges))


def run(function: Callable[[int], None], pieces: Iterable[int]) -> None:
    """Call the function for each piece, on as many threads as torch uses."""
    num_threads = torch.get_num_threads()
    if num_threads == 1:
        for piece in pieces:
            function(piece)
    else:
        # A list, because only reading the results raises what a thread has raised.
        list(_pool(num_threads).map(function, pieces))


@lru_cache
def _pool(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, "kernels")


# A forked process inherits the pool, but not its threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
