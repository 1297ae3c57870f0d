"""The names of the color corrections: commands show them without importing torch."""

from __future__ import annotations

from typing import Literal

ColorCorrectionProtocol = Literal["affine", "affine-test", "translated-gamma", "network", "none"]
"""How the colors of renderings are fitted to images."""
