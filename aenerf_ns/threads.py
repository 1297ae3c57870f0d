"""Threads for kernels that release Python's lock, as many as torch uses.

They are not numba's own threads, which die when two Python threads enter them at once, as the viewer and the training
do, and whose kernels take more than twice as long to compile.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch


def run_ranges(function: Callable[[int, int], None], length: int, block: int = 1) -> None:
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
