"""Lookup of twists for CPUs: kernels compiled by numba, which :mod:`.comoving` differentiates."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.method.kernels.cpu import as_array, compiled, run_ranges

# Points that one thread computes at least.
_BLOCK = 4096

_F = np.float32
_ZERO, _HALF, _ONE = _F(0), _F(0.5), _F(1)


def values(grid: Tensor, unit: Tensor) -> Tensor:
    """Return the values (N, columns) of a contiguous grid (r, r, r, columns) at contiguous places (N, 3)."""
    out = unit.new_empty(len(unit), grid.shape[-1])
    cells, places, found = as_array(grid), as_array(unit), as_array(out)
    run_ranges(lambda first, last: _fill_values(cells, places[first:last], found[first:last]), len(unit), _BLOCK)
    return out


def gradient(unit: Tensor, grad: Tensor, resolution: int) -> Tensor:
    """Return the gradient (r, r, r, columns) of the grid for that (N, columns) of its values.

    One thread adds up, because several would need a grid each and would change the order of the sums.
    """
    out = grad.new_zeros(resolution, resolution, resolution, grad.shape[-1])
    _add_gradient(as_array(unit), as_array(grad), as_array(out))
    return out


def probe(device: torch.device) -> None:
    """Compute one value."""
    values(torch.zeros(2, 2, 2, 6, device=device), torch.zeros(1, 3, device=device))


@compiled
def _place(unit, resolution):
    """Return the cell below a coordinate in [0, 1], and the share of the next cell."""
    x = unit * _F(resolution) - _HALF
    last = _F(resolution - 1)
    # Not a number fails every comparison: it must not become an index, but it must stay in the share.
    inside = x if x > _ZERO else _ZERO
    lower = min(int(inside if inside < last else last), resolution - 2)
    bounded = x if not x < _ZERO else _ZERO
    return lower, (bounded if not bounded > last else last) - _F(lower)


@compiled
def _cells(unit, resolution):
    """Return the cell (i, j, k) below a place (3,) in the unit cube, and the shares of the next cells."""
    i, u = _place(unit[0], resolution)
    j, v = _place(unit[1], resolution)
    k, w = _place(unit[2], resolution)
    return i, j, k, u, v, w


@compiled
def _corner(cells, corner):
    """Return one of the eight cells around a place of :func:`_cells`, and its weight."""
    i, j, k, u, v, w = cells
    a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
    weight = (u if a else _ONE - u) * (v if b else _ONE - v) * (w if c else _ONE - w)
    return i + a, j + b, k + c, weight


@compiled
def _fill_values(grid, unit, out):
    resolution, columns = grid.shape[0], grid.shape[3]
    for n in range(len(unit)):
        cells = _cells(unit[n], resolution)
        for column in range(columns):
            out[n, column] = _ZERO
        for corner in range(8):
            i, j, k, weight = _corner(cells, corner)
            for column in range(columns):
                out[n, column] += weight * grid[i, j, k, column]


@compiled
def _add_gradient(unit, grad, out):
    resolution, columns = out.shape[0], out.shape[3]
    for n in range(len(unit)):
        cells = _cells(unit[n], resolution)
        for corner in range(8):
            i, j, k, weight = _corner(cells, corner)
            for column in range(columns):
                out[i, j, k, column] += weight * grad[n, column]
