"""Measure how far interpolated poses are from the camera's path, between given poses.

    python -m benchmarks.base_poses --output benchmarks/results/base_poses_cpu2.json

Takes poses from the built-in paths at hard speed, adds independent noise, leaves frames out, and compares three ways to
interpolate with the path. Linear: positions linearly, rotations spherically. Cubic: the trajectory of this project.
Smoothing: SciPy's cubic smoothing spline, which chooses its strength by generalized cross-validation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.simulator.paths import ObjectPath, RoomPath, SpeedProfile
from benchmarks.common import write_result

_PATHS = {"object": ObjectPath(), "room": RoomPath()}
_DURATION = 4.0
_FINE_STEP = 1e-3


@dataclass
class BasePoses:
    """Compare interpolated poses with the path that the given poses are on."""

    output: Path
    """JSON file to write."""
    rates: tuple[float, ...] = (25.0, 50.0, 125.0)
    """Poses a second."""
    noises: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.15, 0.005), (0.5, 0.02))
    """Root mean squares of the noise of the given poses, in degrees and meters."""
    lost: tuple[int, ...] = (1, 2, 4, 8)
    """Frames in a row that are left out, in the rows on lost frames."""
    seeds: int = 5
    """Number of draws of the noise."""

    def main(self) -> None:
        """Measure and write the mean errors."""
        rows = [
            {"path": name, "rate": rate, "noise_degrees": degrees, "noise_meters": meters}
            | _whole_path(name, rate, degrees, meters, self.seeds)
            for name in _PATHS
            for rate in self.rates
            for degrees, meters in self.noises
        ]
        gaps = [
            {"path": name, "rate": rate, "noise_degrees": degrees, "noise_meters": meters, "lost": lost}
            | _lost_frames(name, rate, degrees, meters, lost)
            for name in _PATHS
            for rate in self.rates[-1:]
            for degrees, meters in self.noises
            for lost in self.lost
        ]
        write_result(self.output, {"duration_easy": _DURATION, "seeds": self.seeds, "rows": rows, "lost_frames": gaps})


def _linear(times: NDArray[np.int64], poses: Tensor, at: NDArray[np.int64]) -> Tensor:
    rotations = Slerp(times, Rotation.from_matrix(poses[:, :, :3].numpy()))(at).as_matrix()
    positions = np.stack([np.interp(at, times, poses[:, k, 3].numpy()) for k in range(3)], -1)
    return torch.from_numpy(np.concatenate([rotations, positions[..., None]], -1))


def _cubic(times: NDArray[np.int64], poses: Tensor, at: NDArray[np.int64]) -> Tensor:
    return Trajectory(times, poses).interpolate(at)


def _smoothing(times: NDArray[np.int64], poses: Tensor, at: NDArray[np.int64]) -> Tensor:
    quaternions = Rotation.from_matrix(poses[:, :, :3].numpy()).as_quat()
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0, -1, 1).cumprod()
    quaternions[1:] *= flips[:, None]
    # In units of the distance of the poses, because the solver of SciPy's cross-validation minds small steps.
    unit = np.diff(times).mean()
    values = np.concatenate([quaternions, poses[:, :, 3].numpy()], -1)
    smooth = np.stack([make_smoothing_spline(times / unit, column)(at / unit) for column in values.T], -1)
    rotations = Rotation.from_quat(smooth[:, :4]).as_matrix()
    return torch.from_numpy(np.concatenate([rotations, smooth[:, 4:, None]], -1))


_WAYS: dict[str, Callable[[NDArray[np.int64], Tensor, NDArray[np.int64]], Tensor]] = {
    "linear": _linear,
    "cubic": _cubic,
    "smoothing": _smoothing,
}


def _whole_path(name: str, rate: float, degrees: float, meters: float, seeds: int) -> dict:
    profile = SpeedProfile("hard", _DURATION)
    times = np.rint(np.arange(0, profile.duration, 1 / rate) * 1e9).astype(np.int64)
    fine = np.arange(0, times[-1], round(_FINE_STEP * 1e9))
    knots, truth = _true_poses(name, profile, times), _true_poses(name, profile, fine)
    errors: dict[str, list[tuple[float, float]]] = {way: [] for way in _WAYS}
    for seed in range(seeds if degrees or meters else 1):
        given = _with_noise(knots, degrees, meters, seed)
        for way, interpolate in _WAYS.items():
            errors[way].append(_mean_errors(interpolate(times, given, fine), truth))
    return _means(errors)


def _lost_frames(name: str, rate: float, degrees: float, meters: float, lost: int) -> dict:
    """Measure the errors while frames are lost, at ten places of the path."""
    profile = SpeedProfile("hard", _DURATION)
    times = np.rint(np.arange(0, profile.duration, 1 / rate) * 1e9).astype(np.int64)
    knots = _true_poses(name, profile, times)
    errors: dict[str, list[tuple[float, float]]] = {"linear": [], "cubic": []}
    for seed, first in enumerate(np.linspace(5, len(times) - lost - 5, 10).astype(int)):
        kept = np.delete(np.arange(len(times)), np.s_[first : first + lost])
        fine = np.linspace(times[first - 1], times[first + lost], 50).astype(np.int64)
        given, truth = _with_noise(knots, degrees, meters, seed)[kept], _true_poses(name, profile, fine)
        for way in errors:
            errors[way].append(_mean_errors(_WAYS[way](times[kept], given, fine), truth))
    return _means(errors)


def _true_poses(name: str, profile: SpeedProfile, times: NDArray[np.int64]) -> Tensor:
    parameters = profile.parameter(times * 1e-9).clip(0, 1)
    return torch.from_numpy(np.stack([_PATHS[name](float(s))[:3] for s in parameters]))


def _with_noise(poses: Tensor, degrees: float, meters: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.randn(2, len(poses), 3, generator=generator, dtype=torch.float64) / math.sqrt(3)
    rotations = poses[..., :3] @ rotation_from_vector(math.radians(degrees) * turn)
    return torch.cat([rotations, poses[..., 3:] + meters * shift[..., None]], -1)


def _mean_errors(poses: Tensor, truth: Tensor) -> tuple[float, float]:
    degrees = torch.rad2deg(rotation_angle(poses, truth)).mean()
    return float(degrees), float((poses - truth)[..., 3].norm(dim=-1).mean())


def _means(errors: dict[str, list[tuple[float, float]]]) -> dict:
    means = {way: np.mean(values, 0) for way, values in errors.items()}
    return {way: {"degrees": float(mean[0]), "meters": float(mean[1])} for way, mean in means.items()}


if __name__ == "__main__":
    tyro.cli(BasePoses).main()
