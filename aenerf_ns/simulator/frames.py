"""Choose where along a path the frames of a simulation lie, so that the image moves little between two frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.scene import SimulationScene

_PROBE_WIDTH = 24
DISPLACEMENT_PERCENTILE = 99.0
"""Percentage of the picture that a limit on the motion between two pictures holds for."""
_MARGIN = 0.98
"""Each step is guessed from the step before. A target a little below the limit saves most second guesses."""
_MAX_STEP = 0.01


def frame_displacement(
    depth: ArrayLike,
    first_camera_to_world: ArrayLike,
    second_camera_to_world: ArrayLike,
    intrinsics: Sequence[float],
    sees_infinity: bool = False,
) -> float:
    """Return the 99th percentile of how far pixels move from one view to another, in pixels.

    It is 0 if nothing is seen, and inf if a point lies behind the second camera.

    Args:
        depth: (H, W) of the first view along its optical axis, inf where there is no surface.
        first_camera_to_world, second_camera_to_world: (4, 4), OpenCV axes.
        intrinsics: (fx, fy, cx, cy) of the depth map, pixel centers at +0.5.
        sees_infinity: whether pixels of depth inf show something, which then moves as the camera turns.
    """
    depth = np.asarray(depth, np.float64)
    fx, fy, cx, cy = intrinsics
    finite = np.isfinite(depth)
    y, x = np.nonzero(finite | sees_infinity)
    if len(x) == 0:
        return 0.0
    u, v = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
    first, second = np.asarray(first_camera_to_world, np.float64), np.asarray(second_camera_to_world, np.float64)
    rotation = second[:3, :3].T @ first[:3, :3]
    shift = second[:3, :3].T @ (first[:3, 3] - second[:3, 3])
    # A point at infinity is a direction, which a shift does not change.
    near = finite[y, x]
    points = np.stack([u, v, np.ones_like(u)]) * np.where(near, depth[y, x], 1.0)
    px, py, pz = rotation @ points + shift[:, None] * near
    if pz.min() <= 0:
        return np.inf
    return float(np.percentile(np.hypot(fx * (px / pz - u), fy * (py / pz - v)), DISPLACEMENT_PERCENTILE))


def frame_parameters(
    scene: SimulationScene, intrinsics: Sequence[float], width: int, height: int, max_displacement: float
) -> Array:
    """Return path parameters (N,), 0 to 1, between which 99 % of the picture moves at most ``max_displacement``.

    The displacement, in pixels of the full picture, is the `frame_displacement` of a coarse depth map. Frames lie as
    far apart as the limit allows. An environment counts; a uniform background does not, because its motion is
    invisible. The parameters do not depend on the camera's speed.
    """
    shrink = _PROBE_WIDTH / width
    rows = int(np.ceil(height * shrink))
    probe = tuple(shrink * np.asarray(intrinsics, np.float64))
    target, sees_infinity = _MARGIN * max_displacement, scene.renderer.background is None
    # A probe is too small to share among threads: synchronizing them takes longer than rendering.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        parameters, pose, step = [0.0], scene.path(0.0), 1e-4
        while parameters[-1] < 1.0:
            depth = scene.renderer.render(pose, probe, _PROBE_WIDTH, rows, 1)[1]
            while True:
                step = min(step, _MAX_STEP, 1.0 - parameters[-1])
                next_pose = scene.path(parameters[-1] + step)
                displacement = frame_displacement(depth, pose, next_pose, probe, sees_infinity) / shrink
                if displacement <= max_displacement:
                    break
                step *= max(target / displacement, 0.1)
            # Rounding may leave the sum just below 1.
            parameters.append(1.0 if step == 1.0 - parameters[-1] else parameters[-1] + step)
            pose = next_pose
            step *= min(target / max(displacement, 1e-12), 4.0)
    finally:
        torch.set_num_threads(threads)
    return np.array(parameters)
