"""Short names of the array types that scenes are made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Texture = NDArray[np.float32]
"""A picture (rows, columns, 3) of linear RGB, the lowest row first."""
