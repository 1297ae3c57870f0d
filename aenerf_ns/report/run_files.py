"""Read the files that a run wrote of its own training: how it was made, and the scalars that it logged."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import Literal

import msgspec

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.json_file import read_json
from aenerf_ns.files.limits import require_at_most
from aenerf_ns.training.run_record import RUN_FILE, SCALARS_FILE

# Points of a curve. More are not seen, and make the page large.
_MAX_POINTS = 1000
# A million logged lines have 40 MB.
_MAX_BYTES = 1 << 28


class Machine(msgspec.Struct):
    """Where a run was trained."""

    cpu: str
    cores: int
    gpu: str | None = None
    torch_threads: int | None = None


class TrainingRecord(msgspec.Struct, kw_only=True):
    """How a run was made: what :class:`~aenerf_ns.training.run_record.RunRecord` writes."""

    state: Literal["training", "finished", "stopped"]
    first_step: int
    planned_steps: int
    steps: int
    started: str
    seconds: float
    seed: int | None = None
    command: str | None = None
    commit: str | None = None
    versions: dict[str, str | None] = {}
    machine: Machine | None = None
    peak_memory_bytes: dict[Literal["host", "gpu"], int | None] = {}

    def describe_state(self) -> str:
        """Say how far the training came."""
        begun = f" from step {self.first_step:,} on" if self.first_step else ""
        if self.state == "finished":
            return f"finished: all {self.planned_steps:,} steps{begun}"
        if self.state == "stopped":
            return f"stopped after {self.steps:,} of {self.planned_steps:,} steps{begun}"
        return f"still training, or killed: it was to take {self.planned_steps:,} steps{begun}"


def read_record(folder: Path) -> TrainingRecord | None:
    """Read how a run was made, None where it was made before runs recorded it.

    Raises:
        DataError: the file cannot be read, or lacks what the report shows.
    """
    path = folder / RUN_FILE
    return read_json(path, TrainingRecord, "copy the run again, or remove the file") if path.exists() else None


def read_scalars(folder: Path) -> dict[str, tuple[list[int], list[float]]] | None:
    """Read steps and values of each logged scalar by name, thinned evenly; None where none were kept.

    Raises:
        DataError: the file cannot be read.
    """
    path = folder / SCALARS_FILE
    if not path.exists():
        return None
    curves: dict[str, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
    with reading(path):
        require_at_most(path, _MAX_BYTES)
        try:
            with path.open(encoding="utf8", newline="") as file:
                for row in csv.DictReader(file):
                    (steps, values), step = curves[row["name"]], int(row["step"])
                    # A run that was killed goes on from its last checkpoint, and logs some steps again.
                    while steps and steps[-1] >= step:
                        steps.pop(), values.pop()
                    steps.append(step)
                    values.append(float(row["value"]))
        except (ValueError, KeyError, TypeError, csv.Error) as error:
            # The last line of a run that was killed may be incomplete.
            raise DataError(path, f"it cannot be read ({error!r})", "remove the incomplete line, or the file") from None
    return {name: _thin(*curve) for name, curve in curves.items()}


def _thin(steps: list[int], values: list[float]) -> tuple[list[int], list[float]]:
    every = -(-len(steps) // _MAX_POINTS)
    return steps[::every], values[::every]
