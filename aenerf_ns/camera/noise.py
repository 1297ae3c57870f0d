"""Time-correlated pose noise, which stands in for the errors of structure from motion."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory

_NUM_WAVES = 64


def perturb(
    trajectory: Trajectory,
    rotation_degrees: float,
    translation: float,
    correlation_time: float,
    seed: int,
    kind: Literal["smooth", "gauss-markov"] = "smooth",
) -> Trajectory:
    """Return a trajectory with errors of a given size.

    The error's three rotation and three translation components are independent Gaussian processes. Smooth ones have
    the correlation exp(−(Δt / correlation_time)² / 2). They are drawn as sums of random waves (random Fourier
    features), which are defined at any time and do not depend on the rate of the poses. First-order Gauss-Markov ones
    have the correlation exp(−Δt / correlation_time), and jump from pose to pose (the protocol of E-3DGS, 3DV 2025).

    Args:
        trajectory: the true camera-to-world poses.
        rotation_degrees: root mean square over the knots of the error's angle, in degrees.
        translation: root mean square of the error's length, in the units of the poses.
        correlation_time: in seconds.
        seed: of the random draw.
        kind: of the processes.

    Returns:
        The trajectory whose pose at each knot is the true one composed with the error, in the camera's frame.
    """
    generator = torch.Generator().manual_seed(seed)
    seconds = trajectory.seconds(trajectory.times)
    if kind == "smooth":
        shape = (_NUM_WAVES, 6)
        frequency = torch.randn(shape, generator=generator, dtype=torch.float64) / correlation_time
        phase = torch.rand(shape, generator=generator, dtype=torch.float64) * (2 * math.pi)
        # In parts, because all waves of many poses would fill the memory.
        parts = seconds[:, None, None].split(10_000)
        error = torch.cat([torch.cos(part * frequency + phase).sum(1) for part in parts])
    else:
        error = torch.randn((len(seconds), 6), generator=generator, dtype=torch.float64)
        kept = torch.exp(-seconds.diff() / correlation_time)
        for index in range(1, len(seconds)):
            share = kept[index - 1]
            error[index] = share * error[index - 1] + (1 - share.square()).sqrt() * error[index]
    rotation_error = _with_root_mean_square(error[:, :3], math.radians(rotation_degrees))
    translation_error = _with_root_mean_square(error[:, 3:], translation)
    rotations, positions = trajectory.camera_to_worlds[..., :3], trajectory.camera_to_worlds[..., 3:]
    noisy = torch.cat(
        [rotations @ rotation_from_vector(rotation_error), positions + rotations @ translation_error[..., None]], -1
    )
    return Trajectory(trajectory.times, noisy, trajectory.source)


def _with_root_mean_square(vectors: Tensor, size: float) -> Tensor:
    return vectors * (size / vectors.square().sum(-1).mean().sqrt())
