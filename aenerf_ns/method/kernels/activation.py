"""The sharp softplus for CPUs: kernels compiled by numba, which :mod:`.activation` differentiates.

The exponential and the logarithm are polynomials, which the compiler computes for eight or more values at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.method.kernels.cpu import as_array, compiled
from aenerf_ns.threads import run_ranges

# Values that one thread computes at least.
_BLOCK = 4096

_F = np.float32
_ZERO, _HALF, _ONE, _TWO = _F(0), _F(0.5), _F(1), _F(2)
# exp(-40) vanishes beside 1. Processors are slow at smaller numbers, whose squares are too small for normal float32.
_MAX_EXPONENT = _F(40)
_LOG2_E = _F(1.4426950408889634)
# ln 2 in two parts. The first has few bits, so its products with whole numbers are exact.
_LN_2, _LN_2_REST = _F(0.693145751953125), _F(1.42860677e-06)


def values(inputs: Tensor, tangents: Tensor | None, beta: float) -> tuple[Tensor, Tensor | None]:
    """Return log(1 + exp(beta x)) / beta, and its rates where the inputs have tangents. All tensors are contiguous."""
    out = torch.empty_like(inputs)
    rates = None if tangents is None else torch.empty_like(inputs)
    _run(_fill_values, beta, inputs, tangents, out, rates)
    return out, rates


def gradients(
    outputs: Tensor, tangents: Tensor | None, grad: Tensor, grad_rates: Tensor | None, beta: float
) -> tuple[Tensor, Tensor | None]:
    """Return the gradients of the inputs, and those of the tangents where there are some.

    The derivative is computed from the outputs y, because 1 / (1 + exp(-beta x)) = 1 - exp(-beta y).
    """
    to_inputs = torch.empty_like(outputs)
    to_tangents = None if tangents is None else torch.empty_like(outputs)
    _run(_fill_gradients, beta, outputs, tangents, grad, grad_rates, to_inputs, to_tangents)
    return to_inputs, to_tangents


def self_test(device: torch.device) -> None:
    """Compute one value."""
    values(torch.zeros(1, device=device), None, 1.0)


def _run(kernel: Callable[..., None], beta: float, first_tensor: Tensor, *tensors: Tensor | None) -> None:
    """Run a kernel on all values of contiguous tensors."""
    arrays = [None if tensor is None else as_array(tensor).reshape(-1) for tensor in (first_tensor, *tensors)]

    def run_range(first: int, last: int) -> None:
        # Sliced here, because the compiler makes vectors only of loops that begin at 0.
        kernel(_F(beta), *(None if array is None else array[first:last] for array in arrays))

    run_ranges(run_range, first_tensor.numel(), _BLOCK)


@compiled
def _exponential_of_minus(a):
    """Return exp(-a) for a >= 0, at least exp(-40)."""
    a = _MAX_EXPONENT if a > _MAX_EXPONENT else a
    n = np.floor(_HALF - a * _LOG2_E)
    r = -a - n * _LN_2 - n * _LN_2_REST
    p = _F(1 / 720)
    p = p * r + _F(1 / 120)
    p = p * r + _F(1 / 24)
    p = p * r + _F(1 / 6)
    p = p * r + _HALF
    p = p * r + _ONE
    p = p * r + _ONE
    # 2^n, written as the exponent of a float32.
    return p * np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)


@compiled
def _logarithm_of_one_plus(u):
    """Return log(1 + u) for u in [0, 1], by the series of the inverse hyperbolic tangent."""
    s = u / (_TWO + u)
    q = s * s
    p = _F(1 / 13)
    p = p * q + _F(1 / 11)
    p = p * q + _F(1 / 9)
    p = p * q + _F(1 / 7)
    p = p * q + _F(1 / 5)
    p = p * q + _F(1 / 3)
    return _TWO * s * (p * q + _ONE)


@compiled
def _fill_values(beta, inputs, tangents, out, rates):
    scale = _ONE / beta
    for i in range(len(inputs)):
        z = beta * inputs[i]
        y = (z if z > _ZERO else _ZERO) + _logarithm_of_one_plus(_exponential_of_minus(abs(z)))
        out[i] = scale * y
        if tangents is not None:
            rates[i] = tangents[i] * (_ONE - _exponential_of_minus(y))


@compiled
def _fill_gradients(beta, outputs, tangents, grad, grad_rates, to_inputs, to_tangents):
    for i in range(len(outputs)):
        rest = _exponential_of_minus(beta * outputs[i])
        slope = _ONE - rest
        if tangents is None:
            to_inputs[i] = grad[i] * slope
        else:
            to_inputs[i] = slope * (grad[i] + grad_rates[i] * tangents[i] * beta * rest)
            to_tangents[i] = grad_rates[i] * slope
