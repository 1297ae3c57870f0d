"""Checkpoint files: which of them can be loaded."""

from __future__ import annotations

import shlex
import warnings
import zipfile
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError

# What a checkpoint of Nerfstudio's trainer holds at least.
_ENTRIES = {"step", "pipeline", "optimizers", "schedulers", "scalers"}
_OTHER_RUN = "give the folder of another run, or train again"


def checkpoint_to_load(path: Path, step: int | None = None) -> Path:
    """Return the checkpoint of a step, or the newest whole one. Newer ones that are broken are named on the console.

    Args:
        path: a run, its config.yml, its folder of checkpoints, or one of them.
        step: the step in the checkpoint's name, or None.

    Raises:
        DataError: there is no such checkpoint, or it is broken.
    """
    if path.suffix == ".ckpt" or (path.is_file() and path.name != "config.yml"):
        if step is not None and path.name != f"step-{step:09d}.ckpt":
            raise DataError(path, f"it is not the checkpoint of step {step}", "leave --load-step out")
        _require_whole(path)
        return path
    folder = path.parent if path.name == "config.yml" and path.is_file() else path
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder", "give the folder of a trained run")
    if not newest_first(folder) and (folder / "nerfstudio_models").is_dir():
        folder /= "nerfstudio_models"
    if step is not None:
        path = folder / f"step-{step:09d}.ckpt"
        _require_whole(path)
        return path
    broken: list[str] = []
    for path in newest_first(folder):
        fault = _fault(path)
        if fault is None:
            if broken:
                line = f"{folder}: broken checkpoints: {'; '.join(broken)}. {path.name} is loaded"
                CONSOLE.print(line, style="yellow", markup=False, soft_wrap=True)
            return path
        broken.append(f"{path.name} ({fault})")
    problem = f"none of its checkpoints is whole: {'; '.join(broken)}" if broken else "it holds no checkpoint"
    # The folder of an experiment or of a method holds runs.
    below = next((path for depth in range(1, 4) for path in folder.glob("*/" * depth + "config.yml")), None)
    remedy = _OTHER_RUN if below is None else f"give a run: {below.parent}"
    raise DataError(folder, problem, remedy)


def warn_of_later_checkpoints(folder: Path, start: int) -> None:
    """Name on the console a checkpoint of another training, in the folder of one that begins at step ``start``.

    Commands that open a run take its newest checkpoint.
    """
    newest = next(iter(newest_first(folder)), None)
    if newest is not None and step_of(newest) >= start:
        problem = f"{newest.name} is of another training. While it is the newest, the run opens with it"
        line = f"{folder}: {problem}: move it away, or give another --timestamp"
        CONSOLE.print(line, style="yellow", markup=False, soft_wrap=True)


def _require_whole(path: Path) -> None:
    """Raise a DataError that names the newest whole checkpoint beside a checkpoint, unless this one is whole."""
    fault = _fault(path)
    if fault is None:
        return
    whole = next((other for other in newest_first(path.parent) if _fault(other) is None), None)
    remedy = _OTHER_RUN
    if whole is not None:
        # Both options, whichever named the broken one.
        remedy = f"load {whole.name} (--load-dir {shlex.quote(str(whole.parent))} --load-step {step_of(whole)})"
    raise DataError(path, f"the checkpoint cannot be loaded ({fault})", remedy)


def step_of(path: Path) -> int:
    """Return the step in a checkpoint's name."""
    return int(path.stem.removeprefix("step-"))


def newest_first(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, the latest step first."""
    names = [path for path in folder.glob("step-*.ckpt") if path.stem.removeprefix("step-").isdecimal()]
    return sorted(names, key=step_of, reverse=True)


def _fault(path: Path) -> str | None:
    """Return in one line why a checkpoint cannot be loaded, or None if it can."""
    try:
        if path.exists() and not path.is_file():
            return "it is no file"
        with zipfile.ZipFile(path) as archive:
            # torch.save never does. Little may unpack to any size.
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                return "it is compressed"
            # torch.load does not compare the checksums.
            damaged = archive.testzip()
        if damaged is not None:
            return f"{damaged} is damaged"
        with warnings.catch_warnings():
            # torch warns of the kind of pickle before it raises the error.
            warnings.simplefilter("ignore")
            # Without reading the tensors.
            entries = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except OSError as error:
        return error.strerror or str(error)
    # A malformed file raises exceptions of any kind in torch.
    except Exception as error:
        return str(error).partition("\n")[0] or type(error).__name__
    if not isinstance(entries, dict) or not entries.keys() >= _ENTRIES:
        return "it is no checkpoint of a training"
    if not isinstance(entries["step"], int) or entries["step"] < 0 or not isinstance(entries["pipeline"], dict):
        return "its step or its weights are of the wrong kind"
    return None
