"""Write ``run.json`` and ``scalars.csv`` into the folder of a run: how it was made, and the scalars that it logged."""

from __future__ import annotations

import csv
import json
import resource
import sys
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread, decorate_all
from torch import Tensor

from aenerf_ns.training.checkpoints import move_whole
from aenerf_ns.training.provenance import environment

RUN_FILE, SCALARS_FILE = "run.json", "scalars.csv"
"""The files' names in the folder of a run."""

# Figures of the framework that come with every step and tell of the machine alone.
_OF_EVERY_STEP = {name.value for name in writer.EventName} - {writer.EventName.CURR_TEST_PSNR.value}
# ru_maxrss counts in KiB, and on macOS in bytes.
_RESIDENT_UNIT = 1 if sys.platform == "darwin" else 1024


class RunRecord:
    """Writes how a run was made and how it ended: ``run.json``.

    The file is written when the training begins and again when it ends. So the file of a run that was killed says
    that it was still training.

    Args:
        folder: of the run. It exists.
        seed: of the run.
        first_step: the step that the training begins with; above 0 in a run that goes on from a checkpoint.
        num_steps: steps that the training is meant to take.
    """

    def __init__(self, folder: Path, seed: int, first_step: int, num_steps: int) -> None:
        self._path = folder / RUN_FILE
        self._began = time.monotonic()
        self._record: dict[str, Any] = {
            **environment(),
            "seed": seed,
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "first_step": first_step,
            "planned_steps": num_steps,
        }
        self.write("training", 0)

    def write(self, state: str, num_steps: int) -> None:
        """Write the record.

        Args:
            state: "training", "finished" or "stopped".
            num_steps: steps that were made.
        """
        memory: dict[str, int | None] = {
            "host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _RESIDENT_UNIT,
            "gpu": torch.cuda.max_memory_allocated() if torch.cuda.is_available() else None,
        }
        self._record |= {
            "state": state,
            "steps": num_steps,
            "seconds": time.monotonic() - self._began,
            "peak_memory_bytes": memory,
        }
        partial = self._path.with_name(f"{RUN_FILE}.partial")
        partial.write_text(json.dumps(self._record, indent=2) + "\n", "utf8")
        move_whole(partial, self._path)


@decorate_all([check_main_thread])
class ScalarWriter(writer.Writer):
    """Writes all logged scalars but times to ``scalars.csv``: step, name, value. Needs no tensorboard.

    Args:
        folder: of the run. It exists.
    """

    def __init__(self, folder: Path) -> None:
        # Line by line on the disk, so that the file of a run that is killed is whole.
        self._file = (folder / SCALARS_FILE).open("w", encoding="utf-8", newline="", buffering=1)
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow(("step", "name", "value"))

    def write_scalar(self, name: str, scalar: float | Tensor, step: int) -> None:
        """Write one scalar, unless it is a time, or a rate at a step that is not logged otherwise."""
        if name.startswith("learning_rate/") and step % writer.GLOBAL_BUFFER["steps_per_log"]:
            return
        if name not in _OF_EVERY_STEP:
            self._rows.writerow((step, name, f"{float(scalar):.6g}"))

    def write_image(self, name: str, image: Tensor, step: int) -> None:
        """Do nothing: pictures are for tensorboard."""

    def write_config(self, name: str, config_dict: Mapping[str, Any], step: int) -> None:
        """Do nothing: the configuration is in config.yml."""
