"""The event ray sampler: random pairs of events, as rays at both ends of their intervals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.event_camera import EventCamera
from aenerf_ns.events.pairs import EventPairs
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.trajectory.trajectory import Trajectory


class EventRaySampler:
    """Samples pairs of events uniformly and gives each one's rays.

    A pair's interval is [previous time + refractory period, time]. Draws from torch's global generator, which
    Nerfstudio seeds.

    Args:
        pairs: gives the pairs to sample from, which stay in host memory; asked when the first batch is drawn.
        camera: the lens, for the exact direction of each raw pixel.
        sensor: for the refractory period and the pixels' colour filters.
        trajectory: camera-to-world poses, OpenGL camera axes; on the device of the rays.
        num_rays_per_batch: rays of a batch; a pair takes two.
    """

    def __init__(
        self,
        pairs: Callable[[], EventPairs],
        camera: EventCamera,
        sensor: SensorModel,
        trajectory: Trajectory,
        num_rays_per_batch: int,
    ) -> None:
        self.sensor = sensor
        self.trajectory = trajectory
        self.num_rays_per_batch = num_rays_per_batch
        directions, has_direction = camera.pixel_directions()
        if not has_direction.all():
            CONSOLE.print(
                f"[yellow]The lens model gives {(~has_direction).sum()} pixels no direction; their events are left out"
            )
        self._has_direction = has_direction
        self._directions = torch.from_numpy(directions).to(trajectory.times.device)
        # Area of a pixel at distance one from the camera.
        self._pixel_area = 1 / (camera.fx * camera.fy)
        self._pairs = pairs

    def sample(self, num_pairs: int | None = None) -> tuple[RayBundle, dict[str, Any]]:
        """Draws a batch.

        Args:
            num_pairs: number of pairs, by default as many as a batch holds.

        Returns:
            2 N rays, those at the starts of the intervals followed by those at their ends, with ``times`` in float64
            seconds since the trajectory's start; and for each pair ``num_positive`` and ``num_negative`` (N,) counts
            of events at its end and the ``channel`` (N,) of its pixel's filter.
        """
        num_pairs = num_pairs or max(self.num_rays_per_batch // 2, 1)
        pairs, device = self._pairs(), self._directions.device
        index = self._draw(pairs, num_pairs)
        x, y = pairs.x[index].astype(np.int64), pairs.y[index].astype(np.int64)
        starts = pairs.previous_time[index] + self.sensor.refractory_period
        times = torch.from_numpy(np.concatenate([starts, pairs.time[index]])).to(device)
        seconds = self.trajectory.seconds(times)[:, None]
        rows, columns = torch.from_numpy(y).to(device), torch.from_numpy(x).to(device)
        origins, directions = world_rays(
            self.trajectory.pose(seconds[:, 0]), self._directions[rows, columns].repeat(2, 1)
        )
        rays = RayBundle(
            origins=origins.float(),
            directions=directions.float(),
            pixel_area=torch.full((2 * num_pairs, 1), self._pixel_area, device=device),
            camera_indices=torch.zeros((2 * num_pairs, 1), dtype=torch.long, device=device),
            times=seconds,
        )
        batch = {
            "num_positive": torch.from_numpy(pairs.num_positive[index].astype(np.float32)).to(device),
            "num_negative": torch.from_numpy(pairs.num_negative[index].astype(np.float32)).to(device),
            "channel": torch.from_numpy(self.sensor.channel(x, y)).to(device),
        }
        return rays, batch

    def _draw(self, pairs: EventPairs, num_pairs: int) -> np.ndarray:
        """Uniform indices of pairs whose pixel has a direction, by rejection: a copy of the pairs would be costly."""
        drawn = np.empty(0, dtype=np.int64)
        while len(drawn) < num_pairs:
            index = torch.randint(len(pairs), (num_pairs - len(drawn),)).numpy()
            keep = self._has_direction[pairs.y[index], pairs.x[index]]
            drawn = np.concatenate([drawn, index[keep]])
        return drawn


def world_rays(poses: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and unit directions (N, 3) in the world of rays in the camera's frame.

    Args:
        poses: (N, 3, 4) camera-to-world.
        directions: (N, 3) unit vectors in the camera's frame.
    """
    return poses[:, :, 3], (poses[:, :, :3] @ directions[..., None])[..., 0]
