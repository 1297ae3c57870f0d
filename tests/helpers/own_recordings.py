"""A small recording of one's own, of random events, whose files tests write in the ways of users."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

CALIBRATION = {"width": 96, "height": 72, "fl_x": 90.0, "fl_y": 90.0, "cx": 48.0, "cy": 36.0}


def random_events(seconds: float = 2.0, start: float = 0.0, count: int = 2000) -> dict[str, NDArray]:
    """Columns x, y, t in seconds from the start, and p of 0 and 1."""
    rng = np.random.default_rng(0)
    times = start + np.linspace(0, seconds, count)
    x, y, p = (rng.integers(0, limit, count) for limit in (96, 72, 2))
    return {"x": x, "y": y, "t": times, "p": p}


def write_poses(path: Path, seconds: float = 2.0, hertz: int = 100, unit: float = 1.0) -> None:
    """Poses of a camera that slides along x. Times are in seconds, or in another unit as a part of them."""
    times = np.arange(0, seconds + 1e-9, 1 / hertz)
    path.write_text("".join(f"{time / unit:.9f} {time:.6f} 0 0 0 0 0 1\n" for time in times))


def write_calibration(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({"event_camera": {**CALIBRATION, **changes}}))
