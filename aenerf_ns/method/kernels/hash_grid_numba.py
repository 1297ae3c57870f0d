"""The hash grid for CPUs: kernels compiled by numba, which :class:`.hash_grid.HashEncoding` differentiates.

The results are the same bytes for every number of threads: blocks of points are the same for every number of threads,
and a single thread sums a level's gradients.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.method.kernels.cpu import as_array, compiled
from aenerf_ns.threads import run, run_ranges

# A block of points is encoded level by level: its outputs and the level's table then stay in the cache.
_BLOCK = 256


def features(positions: Tensor, tangents: Tensor | None, table: Tensor, scales: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return features (N, 2 levels), and their rates (N, 2 levels) where there are tangents.

    All tensors are float32, contiguous and on one device.

    Args:
        positions: (N, 3) in [0, 1], where N is not 0.
        tangents: (N, 3), the rates of the positions, or None where the positions do not move.
        table: (levels x size, 2), level after level.
        scales: (levels,), the cells along an axis.
    """
    num_points, num_levels = len(positions), len(scales)
    out = positions.new_empty(num_points, 2 * num_levels)
    rates = None if tangents is None else torch.empty_like(out)
    by_level = table.unflatten(0, (num_levels, -1))
    arrays = list(map(as_array, (positions, tangents, by_level, scales, out, rates)))
    run_ranges(lambda first, last: _fill_features(first, last, *arrays), num_points, _BLOCK)
    return out, rates


def gradients(
    positions: Tensor,
    tangents: Tensor | None,
    table: Tensor,
    scales: Tensor,
    grad: Tensor,
    grad_rates: Tensor | None,
    of_positions: bool,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return the gradients of the table, and with ``of_positions`` those of positions and tangents.

    The first four arguments are those of :func:`features`. ``grad`` and ``grad_rates`` (N, 2 levels) are the gradients
    of features and rates.
    """
    num_levels = len(scales)
    to_table = torch.zeros_like(table)
    # A part for each level, because the levels are summed at the same time.
    parts = positions.new_empty(num_levels, *positions.shape) if of_positions else None
    tangent_parts = positions.new_empty(num_levels, *positions.shape) if of_positions and tangents is not None else None
    by_level, to_levels = (values.unflatten(0, (num_levels, -1)) for values in (table, to_table))
    tensors = (positions, tangents, by_level, scales, grad, grad_rates, to_levels, parts, tangent_parts)
    arrays = list(map(as_array, tensors))
    # The finest level first: its table is the furthest apart in memory, so it takes longest.
    run(lambda level: _add_gradients(level, *arrays), reversed(range(num_levels)))
    return to_table, _sum_of_levels(parts), _sum_of_levels(tangent_parts)


def _sum_of_levels(parts: Tensor | None) -> Tensor | None:
    # By numpy, which adds level after level.
    return None if parts is None else torch.from_numpy(parts.numpy().sum(0))


def self_test(device: torch.device) -> None:
    """Encode one point."""
    features(torch.zeros(1, 3, device=device), None, torch.zeros(1, 2, device=device), torch.ones(1, device=device))


@compiled
def _cell(positions, i, scale, mask):
    """Return a point's distances from the lower corner of its cell and from the upper one, as x, y, z, u, v, w, and the
    indices of the 8 corners in the table.

    The first axis changes fastest from corner to corner.
    """
    x, y, z = positions[i, 0] * scale, positions[i, 1] * scale, positions[i, 2] * scale
    low_x, low_y, low_z = np.floor(x), np.floor(y), np.floor(z)
    one, prime_y, prime_z = np.uint32(1), np.uint32(2654435761), np.uint32(805459861)
    x0, y0, z0 = np.uint32(np.int32(low_x)), np.uint32(np.int32(low_y)), np.uint32(np.int32(low_z))
    # Numba's products and sums of 32 bits have 64 bits.
    x1 = np.uint32(x0 + one)
    y0, z0 = np.uint32(y0 * prime_y), np.uint32(z0 * prime_z)
    y1, z1 = np.uint32(y0 + prime_y), np.uint32(z0 + prime_z)
    a, b, c, d = x0 ^ y0, x1 ^ y0, x0 ^ y1, x1 ^ y1
    near = (a ^ z0) & mask, (b ^ z0) & mask, (c ^ z0) & mask, (d ^ z0) & mask
    far = (a ^ z1) & mask, (b ^ z1) & mask, (c ^ z1) & mask, (d ^ z1) & mask
    x, y, z, unit = x - low_x, y - low_y, z - low_z, np.float32(1)
    return (x, y, z, unit - x, unit - y, unit - z), near + far


@compiled
def _corner_values(rows, indices, feature):
    a, b, c, d, e, f, g, h = indices
    return (
        rows[a, feature], rows[b, feature], rows[c, feature], rows[d, feature],
        rows[e, feature], rows[f, feature], rows[g, feature], rows[h, feature],
    )  # fmt: skip


@compiled
def _corner_products(rows, indices, first, second):
    """Return the dot products of the corners' features with a gradient."""
    a, b, c, d, e, f, g, h = indices
    return (
        rows[a, 0] * first + rows[a, 1] * second, rows[b, 0] * first + rows[b, 1] * second,
        rows[c, 0] * first + rows[c, 1] * second, rows[d, 0] * first + rows[d, 1] * second,
        rows[e, 0] * first + rows[e, 1] * second, rows[f, 0] * first + rows[f, 1] * second,
        rows[g, 0] * first + rows[g, 1] * second, rows[h, 0] * first + rows[h, 1] * second,
    )  # fmt: skip


@compiled
def _weights(offsets):
    """Return the trilinear weights of the corners."""
    x, y, z, u, v, w = offsets
    a, b, c, d = u * v, x * v, u * y, x * y
    return a * w, b * w, c * w, d * w, a * z, b * z, c * z, d * z


@compiled
def _weight_rates(offsets, rates):
    """Return the derivatives of the corners' weights while the offsets move."""
    x, y, z, u, v, w = offsets
    p, q, r = rates
    # Of the weights in the plane of the first two axes.
    ta, tb, tc, td = -p * v - q * u, p * v - q * x, q * u - p * y, p * y + q * x
    a, b, c, d = u * v * r, x * v * r, u * y * r, x * y * r
    return ta * w - a, tb * w - b, tc * w - c, td * w - d, ta * z + a, tb * z + b, tc * z + c, td * z + d


@compiled
def _value(weights, values):
    a, b, c, d, e, f, g, h = weights
    k, l, m, n, o, p, q, r = values  # noqa: E741
    return (a * k + b * l + c * m + d * n) + (e * o + f * p + g * q + h * r)


@compiled
def _slopes(offsets, values):
    """Return the derivatives of the interpolated value along the axes."""
    x, y, z, u, v, w = offsets
    a, b, c, d, e, f, g, h = values
    return (
        w * (v * (b - a) + y * (d - c)) + z * (v * (f - e) + y * (h - g)),
        w * (u * (c - a) + x * (d - b)) + z * (u * (g - e) + x * (h - f)),
        v * (u * (e - a) + x * (f - b)) + y * (u * (g - c) + x * (h - d)),
    )


@compiled
def _mixed_slopes(offsets, values):
    """Return the second derivatives along two axes: first and second, first and third, second and third."""
    x, y, z, u, v, w = offsets
    a, b, c, d, e, f, g, h = values
    return (
        w * ((d - c) - (b - a)) + z * ((h - g) - (f - e)),
        v * ((f - e) - (b - a)) + y * ((h - g) - (d - c)),
        u * ((g - e) - (c - a)) + x * ((h - f) - (d - b)),
    )


@compiled
def _add_to_corners(rows, indices, weights, first, second):
    for corner in range(8):
        rows[indices[corner], 0] += weights[corner] * first
        rows[indices[corner], 1] += weights[corner] * second


@compiled
def _fill_features(first, last, positions, tangents, table, scales, out, rates):
    """Fill in the features of a range of points, and their rates where there are tangents."""
    mask = np.uint32(table.shape[1] - 1)
    for begin in range(first, last, _BLOCK):
        for level in range(table.shape[0]):
            rows, scale = table[level], scales[level]
            for i in range(begin, min(begin + _BLOCK, last)):
                offsets, indices = _cell(positions, i, scale, mask)
                weights = _weights(offsets)
                for feature in range(2):
                    values = _corner_values(rows, indices, feature)
                    out[i, 2 * level + feature] = _value(weights, values)
                    if tangents is not None:
                        x, y, z = _slopes(offsets, values)
                        along = tangents[i, 0] * x + tangents[i, 1] * y + tangents[i, 2] * z
                        rates[i, 2 * level + feature] = scale * along


@compiled
def _add_gradients(
    level, positions, tangents, table, scales, grad, grad_rates, to_table, to_positions, to_tangents
):  # fmt: skip
    """Add one level's gradients to the table's, and fill in its parts of the other gradients where they are wanted."""
    mask = np.uint32(table.shape[1] - 1)
    rows, row_gradients, scale = table[level], to_table[level], scales[level]
    for i in range(positions.shape[0]):
        offsets, indices = _cell(positions, i, scale, mask)
        first, second = grad[i, 2 * level], grad[i, 2 * level + 1]
        _add_to_corners(row_gradients, indices, _weights(offsets), first, second)
        if tangents is not None:
            moving = scale * tangents[i, 0], scale * tangents[i, 1], scale * tangents[i, 2]
            first_rate, second_rate = grad_rates[i, 2 * level], grad_rates[i, 2 * level + 1]
            _add_to_corners(row_gradients, indices, _weight_rates(offsets, moving), first_rate, second_rate)
        if to_positions is not None:
            x, y, z = _slopes(offsets, _corner_products(rows, indices, first, second))
            if tangents is not None:
                products = _corner_products(rows, indices, first_rate, second_rate)
                tx, ty, tz = _slopes(offsets, products)
                to_tangents[level, i, 0], to_tangents[level, i, 1], to_tangents[level, i, 2] = (
                    scale * tx, scale * ty, scale * tz,
                )  # fmt: skip
                xy, xz, yz = _mixed_slopes(offsets, products)
                p, q, r = moving
                x += q * xy + r * xz
                y += p * xy + r * yz
                z += p * xz + q * yz
            to_positions[level, i, 0], to_positions[level, i, 1], to_positions[level, i, 2] = (
                scale * x, scale * y, scale * z,
            )  # fmt: skip
