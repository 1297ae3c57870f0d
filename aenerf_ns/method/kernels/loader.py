"""Modules of compiled kernels: which tensors they can compute with, and whether they work on this machine."""

from __future__ import annotations

import subprocess
import sys
from functools import lru_cache
from importlib import import_module
from types import ModuleType

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor


def is_float_in_memory(tensor: Tensor) -> bool:
    """Return whether a tensor is float32 and has values of its own, unlike those in torch.func and FakeTensorMode."""
    try:
        return tensor.dtype == torch.float32 and tensor.data_ptr() != 0
    except RuntimeError:
        return False


@lru_cache
def try_load(module: str, device: torch.device) -> ModuleType | None:
    """Return a module whose function ``self_test`` computes something on a device, or say why it does not work."""
    # Nerfstudio's viewer may interrupt its thread at any line. After that, numba can neither be imported nor compile.
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        # Imported lazily: every ns-* command imports the model, and numba is slow to import.
        loaded = import_module(module)
        loaded.self_test(device)
        return loaded
    # Triton raises the last two where there is no compiler or no header of Python.
    except (ImportError, RuntimeError, OSError, subprocess.SubprocessError) as error:
        _warn_once(f"[yellow]Plain torch computes what compiled kernels compute faster: {error}.")
        return None
    finally:
        sys.settrace(trace)


# Modules that need the same library fail for the same reason, which is said once.
@lru_cache
def _warn_once(line: str) -> None:
    CONSOLE.print(line, soft_wrap=True)
