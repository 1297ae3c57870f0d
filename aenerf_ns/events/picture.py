"""Pictures of events."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.events.stream import EventStream

# Display value of a pixel without events, and what one positive or negative event adds to it.
_GRAY = 118
_POSITIVE_STEP = np.array([90, -60, -90])
_NEGATIVE_STEP = np.array([-90, -60, 90])


def polarity_picture(events: EventStream) -> NDArray[np.uint8]:
    """Draw pixels red where positive events prevail, and blue where negative ones do: see :func:`net_picture`."""
    net = np.zeros((events.height, events.width), dtype=np.int64)
    np.add.at(net, (events.y, events.x), events.p)
    return net_picture(net)


def net_picture(net: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Draw the (height, width) positive less negative events of each pixel.

    Returns:
        (height, width, 3) uint8 display colors; gray where there are no events.
    """
    steps = np.abs(net)[..., None] * np.where(net[..., None] > 0, _POSITIVE_STEP, _NEGATIVE_STEP)
    return np.clip(_GRAY + steps, 0, 255).astype(np.uint8)
