"""Short names of the array types that scenes are made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Texture = NDArray[np.float32]
"""A picture (rows, columns, 3) of linear RGB, the lowest row first."""
Panorama = NDArray[np.float32]
"""Radiance from every direction, as an equirectangular picture (rows, columns, 3) of linear RGB.

The first row is straight up. The middle column lies along +x. Columns run clockwise seen from above, so +y lies a
quarter of the width to the left of the middle.
"""
