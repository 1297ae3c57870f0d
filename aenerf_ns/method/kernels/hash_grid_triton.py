"""The hash grid for NVIDIA GPUs: Triton kernels, which :class:`.hash_grid.HashEncoding` differentiates.

A program computes a block of points on one level. Levels are the slow axis of the launch grid, so that the table of one
level stays in the L2 cache while all points go by. The backward pass computes corners and weights again: that is faster
than reading them from memory.

The table's gradient is summed by atomic additions, so its last bits change from run to run.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 128


def features(positions: Tensor, tangents: Tensor | None, table: Tensor, scales: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return features (N, 2 levels), and their rates; see :func:`.hash_grid_numba.features`."""
    num_points, num_levels = len(positions), len(scales)
    # Level after level, as the programs run; a warp then writes to neighboring addresses.
    out = positions.new_empty(num_levels, num_points, 2)
    rates = None if tangents is None else torch.empty_like(out)
    # Triton launches on the current GPU, which Nerfstudio's processes do not set.
    with torch.cuda.device_of(positions):
        _fill_features[(triton.cdiv(num_points, _BLOCK), num_levels)](
            positions, tangents, table, scales, out, rates, num_points, len(table) // num_levels, block=_BLOCK
        )
    return _by_point(out), None if rates is None else _by_point(rates)


def gradients(
    positions: Tensor,
    tangents: Tensor | None,
    table: Tensor,
    scales: Tensor,
    grad: Tensor,
    grad_rates: Tensor | None,
    of_positions: bool,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return the gradients of table, positions and tangents; see :func:`.hash_grid_numba.gradients`."""
    num_points, num_levels = len(positions), len(scales)
    to_table = torch.zeros_like(table)
    # A part for each level: the sum over levels needs no atomic additions.
    parts = positions.new_empty(num_levels, num_points, 3) if of_positions else None
    tangent_parts = torch.empty_like(parts) if parts is not None and tangents is not None else None
    grad_by_level = _by_level(grad, num_levels)
    grad_rates_by_level = None if grad_rates is None else _by_level(grad_rates, num_levels)
    with torch.cuda.device_of(positions):
        _add_gradients[(triton.cdiv(num_points, _BLOCK), num_levels)](
            positions, tangents, table, scales, grad_by_level, grad_rates_by_level, to_table, parts, tangent_parts,
            num_points, len(table) // num_levels, block=_BLOCK,
        )  # fmt: skip
    return to_table, None if parts is None else parts.sum(0), None if tangent_parts is None else tangent_parts.sum(0)


def self_test(device: torch.device) -> None:
    """Encode one point."""
    features(torch.zeros(1, 3, device=device), None, torch.zeros(1, 2, device=device), torch.ones(1, device=device))


def _by_point(values: Tensor) -> Tensor:
    return values.transpose(0, 1).flatten(1)


def _by_level(values: Tensor, num_levels: int) -> Tensor:
    return values.unflatten(1, (num_levels, 2)).transpose(0, 1).contiguous()


@triton.jit
def _load_vectors(pointer, point, inside):
    return (
        tl.load(pointer + 3 * point, mask=inside, other=0.0),
        tl.load(pointer + 3 * point + 1, mask=inside, other=0.0),
        tl.load(pointer + 3 * point + 2, mask=inside, other=0.0),
    )


@triton.jit
def _store_vectors(pointer, point, x, y, z, inside):
    tl.store(pointer + 3 * point, x, mask=inside)
    tl.store(pointer + 3 * point + 1, y, mask=inside)
    tl.store(pointer + 3 * point + 2, z, mask=inside)


@triton.jit
def _load_features(pointer, index, inside):
    return (
        tl.load(pointer + 2 * index, mask=inside, other=0.0),
        tl.load(pointer + 2 * index + 1, mask=inside, other=0.0),
    )


@triton.jit
def _store_features(pointer, index, first, second, inside):
    tl.store(pointer + 2 * index, first, mask=inside)
    tl.store(pointer + 2 * index + 1, second, mask=inside)


@triton.jit
def _cell(x, y, z, scale):
    """Return the lower corners of the cells that the points are in, and the points' distances from them."""
    x, y, z = x * scale, y * scale, z * scale
    low_x, low_y, low_z = tl.floor(x), tl.floor(y), tl.floor(z)
    # Through int32, so that negative numbers wrap as in the plain implementation.
    return (
        low_x.to(tl.int32).to(tl.uint32, bitcast=True),
        low_y.to(tl.int32).to(tl.uint32, bitcast=True),
        low_z.to(tl.int32).to(tl.uint32, bitcast=True),
        x - low_x,
        y - low_y,
        z - low_z,
    )


@triton.jit
def _corner(low_x, low_y, low_z, x, y, z, mask, corner: tl.constexpr):
    """Return the corners' indices in the table, their weights along the axes, and the weights' slopes (1 or -1)."""
    far_x: tl.constexpr = corner & 1
    far_y: tl.constexpr = (corner >> 1) & 1
    far_z: tl.constexpr = (corner >> 2) & 1
    index = (low_x + far_x) ^ ((low_y + far_y) * 2654435761) ^ ((low_z + far_z) * 805459861)
    weight_x = x if far_x else 1.0 - x
    weight_y = y if far_y else 1.0 - y
    weight_z = z if far_z else 1.0 - z
    slope_x: tl.constexpr = 1.0 if far_x else -1.0
    slope_y: tl.constexpr = 1.0 if far_y else -1.0
    slope_z: tl.constexpr = 1.0 if far_z else -1.0
    return (index & mask).to(tl.int32), weight_x, weight_y, weight_z, slope_x, slope_y, slope_z


@triton.jit
def _fill_features(positions, tangents, table, scales, out, rates, num_points, size, block: tl.constexpr):
    """Fill in the features (levels, N, 2) of a block of points, and their rates where there are tangents."""
    point = tl.program_id(0) * block + tl.arange(0, block)
    level = tl.program_id(1).to(tl.int64)
    inside = point < num_points
    scale = tl.load(scales + level)
    x, y, z = _load_vectors(positions, point, inside)
    low_x, low_y, low_z, x, y, z = _cell(x, y, z, scale)
    first, second = 0.0, 0.0
    if tangents is not None:
        p, q, r = _load_vectors(tangents, point, inside)
        p, q, r = p * scale, q * scale, r * scale
        first_rate, second_rate = 0.0, 0.0
    for corner in tl.static_range(8):
        index, wx, wy, wz, sx, sy, sz = _corner(low_x, low_y, low_z, x, y, z, size - 1, corner)
        a, b = _load_features(table + 2 * level * size, index, inside)
        weight = wx * wy * wz
        first += weight * a
        second += weight * b
        if tangents is not None:
            weight_rate = sx * p * wy * wz + sy * q * wx * wz + sz * r * wx * wy
            first_rate += weight_rate * a
            second_rate += weight_rate * b
    _store_features(out, level * num_points + point, first, second, inside)
    if tangents is not None:
        _store_features(rates, level * num_points + point, first_rate, second_rate, inside)


@triton.jit
def _add_gradients(
    positions, tangents, table, scales, grad, grad_rates, to_table, to_positions, to_tangents, num_points, size,
    block: tl.constexpr,
):  # fmt: skip
    """Add a block of points to the table's gradient, and fill in the parts (levels, N, 3) of the wanted others."""
    point = tl.program_id(0) * block + tl.arange(0, block)
    level = tl.program_id(1).to(tl.int64)
    inside = point < num_points
    scale = tl.load(scales + level)
    x, y, z = _load_vectors(positions, point, inside)
    low_x, low_y, low_z, x, y, z = _cell(x, y, z, scale)
    first, second = _load_features(grad, level * num_points + point, inside)
    if tangents is not None:
        p, q, r = _load_vectors(tangents, point, inside)
        p, q, r = p * scale, q * scale, r * scale
        first_rate, second_rate = _load_features(grad_rates, level * num_points + point, inside)
    if to_positions is not None:
        gx, gy, gz = 0.0, 0.0, 0.0
        if tangents is not None:
            hx, hy, hz = 0.0, 0.0, 0.0
    for corner in tl.static_range(8):
        index, wx, wy, wz, sx, sy, sz = _corner(low_x, low_y, low_z, x, y, z, size - 1, corner)
        weight = wx * wy * wz
        to_first, to_second = weight * first, weight * second
        if tangents is not None:
            weight_rate = sx * p * wy * wz + sy * q * wx * wz + sz * r * wx * wy
            to_first += weight_rate * first_rate
            to_second += weight_rate * second_rate
        rows = to_table + 2 * level * size
        tl.atomic_add(rows + 2 * index, to_first, mask=inside, sem="relaxed")
        tl.atomic_add(rows + 2 * index + 1, to_second, mask=inside, sem="relaxed")
        if to_positions is not None:
            a, b = _load_features(table + 2 * level * size, index, inside)
            product = first * a + second * b
            gx += sx * wy * wz * product
            gy += sy * wx * wz * product
            gz += sz * wx * wy * product
            if tangents is not None:
                product = first_rate * a + second_rate * b
                gx += (sx * sy * q * wz + sx * sz * r * wy) * product
                gy += (sx * sy * p * wz + sy * sz * r * wx) * product
                gz += (sx * sz * p * wy + sy * sz * q * wx) * product
                hx += sx * wy * wz * product
                hy += sy * wx * wz * product
                hz += sz * wx * wy * product
    if to_positions is not None:
        index = level * num_points + point
        _store_vectors(to_positions, index, gx * scale, gy * scale, gz * scale, inside)
        if tangents is not None:
            _store_vectors(to_tangents, index, hx * scale, hy * scale, hz * scale, inside)
