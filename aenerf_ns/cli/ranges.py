"""Values of options that no command takes."""

from __future__ import annotations

from aenerf_ns.errors import DataError

RATES = (1e-6, 1e9)
"""Range of the poses or frames a second that a command makes."""


def require_range(option: str, value: float, low: float, high: float) -> None:
    """Raise a DataError if the value of an option is outside a range or not a number."""
    if not low <= value <= high:
        raise DataError(f"--{option}", f"{value} is out of range", f"give a number from {low:g} to {high:g}")


def require_seed(seed: int) -> None:
    """Raise a DataError for a seed that a random generator does not take."""
    require_range("seed", seed, 0, 2**32 - 1)
