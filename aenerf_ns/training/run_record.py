"""Write ``run.json`` and ``scalars.csv`` into the folder of a run: how it was made, and the scalars that it logged."""

from __future__ import annotations

import csv
import fcntl
import json
import resource
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread, decorate_all
from torch import Tensor

from aenerf_ns.atomic_write import atomic_write
from aenerf_ns.errors import DataError
from aenerf_ns.training.framework import is_logged
from aenerf_ns.training.provenance import provenance

RUN_FILE, SCALARS_FILE = "run.json", "scalars.csv"
"""The files' names in the folder of a run."""

# Figures of Nerfstudio that come with every step and describe the machine alone.
_TIMING_NAMES = {name.value for name in writer.EventName} - {writer.EventName.CURR_TEST_PSNR.value}


class RunRecord:
    """Writes how a run was made and how it ended: ``run.json``.

    The file is written when the training begins and again when it ends. So the file of a run that was killed says
    that it was still training.

    Args:
        folder: of the run. It exists.
        seed: of the run.
        steps: that the training is meant to take; they begin above 0 in a run that resumes.
    """

    def __init__(self, folder: Path, seed: int, steps: range) -> None:
        self._path = folder / RUN_FILE
        self._began = time.monotonic()
        self._record: dict[str, Any] = {
            **provenance(),
            "seed": seed,
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "first_step": steps.start,
            "planned_steps": len(steps),
        }
        self.write("training", 0)

    def write(self, state: str, num_steps: int) -> None:
        """Write the record.

        Args:
            state: "training", "finished" or "stopped".
            num_steps: steps that were made.
        """
        self._record |= {
            "state": state,
            "steps": num_steps,
            "seconds": time.monotonic() - self._began,
            "peak_memory_bytes": {
                "host": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
                "gpu": torch.cuda.max_memory_allocated() if torch.cuda.is_available() else None,
            },
        }
        with atomic_write(self._path) as partial:
            partial.write_text(json.dumps(self._record, indent=2) + "\n", "utf8")


@decorate_all([check_main_thread])
class ScalarWriter(writer.Writer):
    """Writes all logged scalars but times to ``scalars.csv``: step, name, value. Needs no tensorboard.

    Args:
        folder: of the run. It exists.
        resumes: whether the run goes on from a checkpoint. What a run in the same folder wrote before is kept.

    Raises:
        DataError: another process writes there.
    """

    def __init__(self, folder: Path, resumes: bool) -> None:
        # Line by line on the disk, so that the file of a run that is killed is whole.
        self._file = (folder / SCALARS_FILE).open("a", encoding="utf-8", newline="", buffering=1)
        try:
            # Trainings that start in one second take one folder. This lock is of a process, and holds between hosts.
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            remedy = "give another --experiment-name or --timestamp"
            raise DataError(folder, "another training writes there", remedy) from None
        except OSError:
            # Some network folders have no locks.
            pass
        if not resumes:
            self._file.seek(0)
            self._file.truncate()
        self._rows = csv.writer(self._file, lineterminator="\n")
        if self._file.tell() == 0:
            self._rows.writerow(("step", "name", "value"))

    def write_scalar(self, name: str, scalar: float | Tensor, step: int) -> None:
        """Write one scalar, unless it is a time, or a rate at a step that is not logged otherwise."""
        if name.startswith("learning_rate/") and not is_logged(step):
            return
        if name not in _TIMING_NAMES:
            self._rows.writerow((step, name, f"{float(scalar):.6g}"))

    def write_image(self, name: str, image: Tensor, step: int) -> None:
        """Do nothing: pictures are for tensorboard."""

    def write_config(self, name: str, config_dict: Mapping[str, Any], step: int) -> None:
        """Do nothing: the configuration is in config.yml."""
