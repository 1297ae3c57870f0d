"""Vectors of three numbers, as tuples, in compiled functions."""

from __future__ import annotations

import math

import numba


@numba.njit(cache=True, error_model="numpy")
def row(array, index):
    """Return the row of an array (N, 3 or more) as a vector."""
    return array[index, 0], array[index, 1], array[index, 2]


@numba.njit(cache=True, error_model="numpy")
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, error_model="numpy")
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, error_model="numpy")
def length(a):
    return math.sqrt(dot(a, a))


@numba.njit(cache=True, error_model="numpy")
def subtract(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(cache=True, error_model="numpy")
def add_scaled(a, factor, b):
    """Return a + factor * b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@numba.njit(cache=True, error_model="numpy")
def divide(a, divisor):
    return a[0] / divisor, a[1] / divisor, a[2] / divisor


@numba.njit(cache=True, error_model="numpy")
def interpolate(values, corners, weights):
    """Return the vector at barycentric coordinates, of vectors (V, 3) at the three corners of a face."""
    i, j, k = corners
    wi, wj, wk = weights
    return (
        wi * values[i, 0] + wj * values[j, 0] + wk * values[k, 0],
        wi * values[i, 1] + wj * values[j, 1] + wk * values[k, 1],
        wi * values[i, 2] + wj * values[j, 2] + wk * values[k, 2],
    )
