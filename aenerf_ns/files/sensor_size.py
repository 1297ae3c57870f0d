"""The size of a sensor, from an event file and from its user."""

from __future__ import annotations

from pathlib import Path

from aenerf_ns.errors import DataError

# The widest address of all formats has 14 bits.
_MAX_SIZE = 1 << 14


def sensor_size(path: Path, stated: tuple[int, int] | None, width: int | None, height: int | None) -> tuple[int, int]:
    """Return the width and height in pixels that the file states, or else the given ones.

    Args:
        path: the event file, for messages.
        stated: width and height that the file states, or None.
        width: the given width, or None.
        height: the given height, or None.

    Raises:
        DataError: neither is known, the two differ, or a size is not one a sensor can have.
    """
    stated_width, stated_height = stated or (None, None)
    width = stated_width if width is None else width
    height = stated_height if height is None else height
    if width is None or height is None:
        raise DataError(path, "the file does not state the size of its sensor", "give its width and height in pixels")
    if stated is not None and (width, height) != stated:
        raise DataError(
            path,
            f"its sensor has {stated_width} x {stated_height} pixels, but {width} x {height} were given",
            "give the calibration of this camera",
        )
    if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
        raise DataError(path, f"a sensor of {width} x {height} pixels cannot be", f"sizes are 1 to {_MAX_SIZE}")
    return width, height
