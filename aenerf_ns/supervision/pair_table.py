"""The table of pairs of events on a device, and how pairs are drawn from it."""

from __future__ import annotations

import warnings

import torch
import torch.nn.functional as F
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.events.pair_store import BLOCK, EventPairs, chain_index, is_pair, max_span

# Share of a device's free memory that the table of pairs may take. The rest is for the model and its gradients.
_SHARE_OF_FREE_MEMORY = 0.5


class PairTable:
    """Draw pairs on the device that holds them.

    Args:
        pairs: all pairs.
        device: of the batches. It also holds the pairs, if they take at most half of its free memory. Otherwise they
            stay in host memory, or in their file, and a step copies two pinned arrays to the device without waiting.
    """

    def __init__(self, pairs: EventPairs, device: torch.device | str) -> None:
        self._batch_device = torch.device(device)
        arrays = (pairs.rows, pairs.replacement_rows, pairs.block_ends)
        size = sum(array.nbytes for array in arrays)
        self._device = self._batch_device
        if self._device.type != "cpu" and size > _SHARE_OF_FREE_MEMORY * torch.cuda.mem_get_info(self._device)[0]:
            self._device = torch.device("cpu")
            CONSOLE.print(
                f"The pairs take {size / 1e9:.1f} GB, more than half of the GPU's free memory: they stay outside"
            )
        self._num_pairs = len(pairs)
        # Known here, because reading it from a GPU in a step would wait for the GPU.
        self._duration = int(pairs.block_ends[-1])
        with warnings.catch_warnings():
            # Torch warns of rows that are mapped read-only. They are only read.
            warnings.simplefilter("ignore", UserWarning)
            self._rows, self._replacement_rows, self._block_ends = (
                torch.from_numpy(array).to(self._device) for array in arrays
            )

    def draw(self, num_moments: int, num_events: int, max_events: int) -> tuple[Tensor, Tensor]:
        """Draw pairs: first around uniform moments at uniform pixels, then pairs that end at uniform events.

        Args:
            num_moments: number of pairs around moments.
            num_events: number of pairs that end at events.
            max_events: the most events that a pair spans.

        Returns:
            (N, 2, 3, 2) int64 rows of the table, of each pair's first and last event: the row before the event's, its
            own, and the row after it. Those of another pixel are told by chain starts. (N,) int64, how many
            consecutive pairs are joined. Both are on the device of the batches.
        """
        device = self._device
        moments = torch.randint(self._duration, (num_moments,), device=device)
        events = torch.randint(self._num_pairs, (num_events,), device=device)
        if max_events == 1:
            spans = torch.ones(num_moments + num_events, dtype=torch.int64, device=device)
        else:
            spans = (max_events + 1) ** torch.rand(num_moments + num_events, dtype=torch.float64, device=device)
            spans = spans.long().clamp_(max=max_events)
        found = find_rows(self._rows, self._replacement_rows, self._block_ends, moments, events, spans)
        spans = found[:, 1] - found[:, 0]
        # The table's first row is a chain start. So it may stand behind the last one, and the last one before it.
        rows = self._rows[(found[..., None] + torch.arange(-1, 2, device=device)) % len(self._rows)]
        if device != self._batch_device:
            rows, spans = (part.pin_memory().to(self._batch_device, non_blocking=True) for part in (rows, spans))
        return rows, spans


def find_rows(
    rows: Tensor, replacement_rows: Tensor, block_ends: Tensor, moments: Tensor, events: Tensor, spans: Tensor
) -> Tensor:
    """Find the rows of pairs in a table of pairs, without waiting for a GPU.

    Args:
        rows, replacement_rows, block_ends: see :class:`~aenerf_ns.events.pair_store.EventPairs`.
        moments: (M,) int64 nanoseconds along the intervals of all pairs, laid end to end. Each finds its pair.
        events: (N - M,) int64 numbers below the number of pairs. Each finds a pair of its own.
        spans: (N,) int64, how many consecutive pairs to join that end with the found one, if that many may be joined.

    Returns:
        (N, 2) int64 numbers of rows: of the event that the pair begins with, and of the one that it ends with.
    """
    number = rows[:, 1][events]
    starts_chain = ~is_pair(number)
    by_event = torch.where(starts_chain, replacement_rows[torch.where(starts_chain, chain_index(number), 0)], events)
    block = torch.searchsorted(block_ends, moments, right=True) - 1
    time, number = rows.view(-1, BLOCK, 2)[block].unbind(-1)
    # From the block's end backwards, because the row before its first belongs to another block.
    elapsed = F.pad(time.diff().masked_fill_(~is_pair(number[:, 1:]), 0).cumsum(1), (1, 0))
    ends = block_ends[block + 1][:, None] - elapsed[:, -1:] + elapsed
    row = torch.cat([BLOCK * block + (ends <= moments[:, None]).sum(1), by_event])
    spans = spans.minimum(max_span(rows[:, 1][row]))
    return torch.stack([row - spans, row], 1)
