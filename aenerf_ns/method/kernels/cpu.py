"""Shared by the kernels for CPUs: the way numba compiles them, and how they take tensors."""

from __future__ import annotations

from typing import Any

import numba
from torch import Tensor

# Contraction is the only freedom from IEEE arithmetic: values that are not finite must stay so.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


def as_array(tensor: Tensor | None) -> Any:
    """Return the tensor's values as an array. Numba compiles a kernel of its own for None."""
    return None if tensor is None else tensor.detach().numpy()
