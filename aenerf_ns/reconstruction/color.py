"""Pictures of a colour sensor, whose pixels each see one channel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def demosaiced(mosaic: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the (height, width, 3) RGB picture of a (height, width) RGGB mosaic, interpolated linearly."""
    return np.asarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB), np.uint8)


def with_lightness(picture: NDArray[np.uint8], grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a (height, width, 3) RGB picture with the lightness (CIELAB's L) of a (height, width) grey one."""
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.cvtColor(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), cv2.COLOR_RGB2LAB)[..., 0]
    return np.asarray(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), np.uint8)
