"""Read the files that a run wrote of its own training: how it was made, and the scalars that it logged."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.json_object import JsonObject
from aenerf_ns.files.limits import require_at_most, require_file
from aenerf_ns.training.run_record import RUN_FILE, SCALARS_FILE

# Points of a curve. More are not seen, and make the page large.
_MOST_POINTS = 1000
_NEEDED = {"first_step": int, "planned_steps": int, "steps": int, "started": str, "seconds": float}
# How far a training came, by the state in its record.
_STATES = {
    "finished": "finished: all {planned:,} steps{begun}",
    "stopped": "stopped after {steps:,} of {planned:,} steps{begun}",
    "training": "still training, or killed: it was to take {planned:,} steps{begun}",
}
_REMEDY = "copy the run again, or remove the file"
# A million logged lines have 40 MB.
_MAX_BYTES = 1 << 28


def read_record(folder: Path) -> dict[str, Any] | None:
    """Return how a run was made, or None where it was made before runs recorded it.

    Raises:
        DataError: the file cannot be read, or lacks what the report shows.
    """
    path = folder / RUN_FILE
    if not path.exists():
        return None
    values = JsonObject.read(path, _REMEDY)
    values.choice("state", tuple(_STATES))
    for name, kind in _NEEDED.items():
        values.get(name, kind)
    if "machine" in values:
        values.block("machine").get("cpu", str)
        values.block("machine").get("cores", int)
    if "peak_memory_bytes" in values:
        memory = values.block("peak_memory_bytes")
        # None on a machine without a GPU.
        for part in [name for name in ("host", "gpu") if not memory.holds(name, type(None))]:
            memory.get(part, int, 0)
    values.get("versions", dict, {})
    # The commit is None outside a checkout.
    for name in [name for name in ("command", "commit") if not values.holds(name, type(None))]:
        values.get(name, str, "")
    return json.loads(path.read_text("utf8"))


def read_scalars(folder: Path) -> dict[str, tuple[list[int], list[float]]] | None:
    """Return steps and values of each logged scalar by name, thinned evenly, or None where none were kept.

    Raises:
        DataError: the file cannot be read.
    """
    path = folder / SCALARS_FILE
    if not path.exists():
        return None
    require_file(path)
    curves: dict[str, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
    with reading(path):
        require_at_most(path, _MAX_BYTES)
        try:
            with path.open(encoding="utf8", newline="") as file:
                for row in csv.DictReader(file):
                    steps, values = curves[row["name"]]
                    steps.append(int(row["step"]))
                    values.append(float(row["value"]))
        except (ValueError, KeyError, TypeError, csv.Error) as error:
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
    return _STATES[record["state"]].format(planned=planned, steps=steps, begun=begun)
