"""The picture of the check: events as they came, beside the same events warped to one view by the poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.checking.contrast import WarpedEvents
from aenerf_ns.events.picture import polarity_picture

_HEIGHT = 480


def warped_picture(warped: WarpedEvents) -> NDArray[np.uint8]:
    """Return the (height, width, 3) picture, enlarged by a whole factor to 480 rows at most."""
    net = np.rint(warped.picture()).astype(np.int64)
    rows, columns = np.nonzero(net)
    picture = polarity_picture(columns, rows, net[rows, columns], net.shape[1], net.shape[0])
    enlarged = max(_HEIGHT // net.shape[0], 1)
    return picture.repeat(enlarged, 0).repeat(enlarged, 1)
