"""Pictures of events."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Display value of a pixel without events, and what one positive or negative event adds to it.
_GRAY = 118
_POSITIVE_STEP = np.array([90, -60, -90])
_NEGATIVE_STEP = np.array([-90, -60, 90])


def polarity_picture(
    x: NDArray[np.integer], y: NDArray[np.integer], polarity: NDArray[np.integer], width: int, height: int
) -> NDArray[np.uint8]:
    """Add up polarities over pixels, and draw pixels red where positive events prevail, blue where negative ones do.

    Args:
        x: (N,) pixel columns.
        y: (N,) pixel rows.
        polarity: (N,) signed number of events.
        width: number of pixel columns.
        height: number of pixel rows.

    Returns:
        (height, width, 3) uint8 display colors; gray where there are no events.
    """
    net = np.zeros((height, width), dtype=np.int64)
    np.add.at(net, (y, x), polarity)
    steps = np.abs(net)[..., None] * np.where(net[..., None] > 0, _POSITIVE_STEP, _NEGATIVE_STEP)
    return np.clip(_GRAY + steps, 0, 255).astype(np.uint8)
