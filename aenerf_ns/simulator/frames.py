"""Where along a path the frames of a simulation must lie, so that the image moves little between two of them."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.simulator.scene import SimulationScene

Array = NDArray[np.float64]

_PROBE_WIDTH = 24
_PERCENTILE = 99.0
_MARGIN = 0.98
"""Each step is guessed from the one before; aiming a little low saves most second guesses."""
_LARGEST_STEP = 0.01


def frame_displacement(
    depth: ArrayLike,
    first_camera_to_world: ArrayLike,
    second_camera_to_world: ArrayLike,
    intrinsics: Sequence[float],
    sees_infinity: bool = False,
) -> float:
    """99th percentile of how far the pixels of one view lie from where they were in another, in pixels.

    Args:
        depth: (H, W) of the first view along its optical axis; inf where no surface is.
        first_camera_to_world, second_camera_to_world: (4, 4), OpenCV axes.
        intrinsics: (fx, fy, cx, cy) of this depth map, pixel centres at +0.5.
        sees_infinity: whether there is something to be seen where the depth is inf: then it moves as the camera turns.

    Returns:
        The percentile, 0 where nothing is seen, inf where the second view has some of it behind the camera.
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
    # A point at infinity is a direction, which shifts leave as it is.
    near = finite[y, x]
    points = np.stack([u, v, np.ones_like(u)]) * np.where(near, depth[y, x], 1.0)
    px, py, pz = rotation @ points + shift[:, None] * near
    if pz.min() <= 0:
        return np.inf
    return float(np.percentile(np.hypot(fx * (px / pz - u), fy * (py / pz - v)), _PERCENTILE))


def frame_parameters(
    scene: SimulationScene,
    intrinsics: Sequence[float],
    width: int,
    height: int,
    maximum_displacement: float = 0.5,
) -> Array:
    """Path parameters (N,), 0 to 1, between which 99 % of what is seen moves at most ``maximum_displacement`` pixels.

    That is the `frame_displacement` of a coarse depth map, in pixels of the full picture, as far apart as it allows. A
    uniform background does not count, for its motion is not seen; an environment does. The parameters do not depend on
    the speed at which the path is travelled.

    Raises:
        ValueError: on a displacement that is not positive.
    """
    if not maximum_displacement > 0:
        raise ValueError(f"maximum_displacement must be positive, got {maximum_displacement}")
    shrink = _PROBE_WIDTH / width
    rows = int(np.ceil(height * shrink))
    probe = tuple(shrink * np.asarray(intrinsics, np.float64))
    target = _MARGIN * maximum_displacement
    # A probe is too small to share among threads: waiting for each other would take longer.
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        parameters, pose, step = [0.0], scene.path(0.0), 1e-4
        while parameters[-1] < 1.0:
            depth = scene.renderer.render(pose, probe, _PROBE_WIDTH, rows, 1)[1]
            while True:
                step = min(step, _LARGEST_STEP, 1.0 - parameters[-1])
                next_pose = scene.path(parameters[-1] + step)
                displacement = frame_displacement(depth, pose, next_pose, probe, scene.background is None) / shrink
                if displacement <= maximum_displacement:
                    break
                step *= max(target / displacement, 0.1)
            # The sum may fall one rounding error short of the end.
            parameters.append(1.0 if step == 1.0 - parameters[-1] else parameters[-1] + step)
            pose = next_pose
            step *= min(target / max(displacement, 1e-12), 4.0)
    finally:
        numba.set_num_threads(threads)
    return np.array(parameters)
