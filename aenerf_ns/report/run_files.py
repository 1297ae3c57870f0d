"""Read the files that a run wrote of its own training: how it was made, and the scalars that it logged."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from aenerf_ns.errors import DataError
from aenerf_ns.training.run_record import RUN_FILE, SCALARS_FILE

# Points of a curve. More are not seen, and make the page large.
_MOST_POINTS = 1000
_NEEDED = {"state", "first_step", "planned_steps", "steps", "started", "seconds"}


def read_record(folder: Path) -> dict[str, Any] | None:
    """Return how a run was made, or None where it was made before runs recorded it.

    Raises:
        DataError: the file cannot be read.
    """
    path = folder / RUN_FILE
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text("utf8"))
    except (OSError, ValueError) as error:
        raise DataError(path, f"it cannot be read ({error})", "copy the run again, or remove the file") from None
    lacking = _NEEDED - (record.keys() if isinstance(record, dict) else set())
    if lacking:
        raise DataError(path, f"it lacks {', '.join(sorted(lacking))}", "copy the run again, or remove the file")
    return record


def read_scalars(folder: Path) -> dict[str, tuple[list[int], list[float]]] | None:
    """Return steps and values of each logged scalar by name, thinned evenly, or None where none were kept.

    Raises:
        DataError: the file cannot be read.
    """
    path = folder / SCALARS_FILE
    if not path.exists():
        return None
    curves: dict[str, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
    try:
        with path.open(encoding="utf8", newline="") as file:
            for row in csv.DictReader(file):
                steps, values = curves[row["name"]]
                steps.append(int(row["step"]))
                values.append(float(row["value"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        # The last line of a run that was killed may be cut.
        raise DataError(path, f"it cannot be read ({error!r})", "remove its last line, or the file") from None
    return {name: _thinned(*curve) for name, curve in curves.items()}


def _thinned(steps: list[int], values: list[float]) -> tuple[list[int], list[float]]:
    every = -(-len(steps) // _MOST_POINTS)
    return steps[::every], values[::every]


def describe_state(record: dict[str, Any] | None) -> str:
    """Return in words how far a training came."""
    if record is None:
        return "not recorded: the run was made by an earlier version"
    steps, planned, first = record["steps"], record["planned_steps"], record["first_step"]
    begun = f" from step {first:,} on" if first else ""
    return {
        "finished": f"finished: all {planned:,} steps{begun}",
        "stopped": f"stopped after {steps:,} of {planned:,} steps{begun}",
        "training": f"still training, or killed: it was to take {planned:,} steps{begun}",
    }[record["state"]]
