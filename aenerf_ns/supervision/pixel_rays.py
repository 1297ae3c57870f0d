"""The rays of an event camera's pixels at times."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.camera.metadata_keys import CAMERA_DIRECTIONS
from aenerf_ns.recording.scene import SceneRecording


class PixelRays:
    """Give pixels their rays, and the channel of their color filter. Pixels are numbered row by row.

    Args:
        scene: the recording.
        device: of the rays.

    Attributes:
        trajectory: the estimated trajectory, which times count from; on the device.
        channels: (pixels,) index of the radiance channel that each pixel sees; on the device.
        usable: (height, width) whether the lens model gives a pixel a direction.
    """

    def __init__(self, scene: SceneRecording, device: torch.device | str) -> None:
        self.trajectory = deepcopy(scene.trajectory).to(device)
        camera = scene.event_camera
        directions, self.usable = camera.pixel_directions()
        if not self.usable.all():
            CONSOLE.print(
                f"[yellow]The lens model gives {(~self.usable).sum()} pixels no direction; their events are left out"
            )
        self._directions = torch.from_numpy(directions).reshape(-1, 3).to(device)
        self.channels = torch.from_numpy(scene.sensor.channels(camera.width, camera.height)).flatten().to(device)
        # Area of a pixel at distance one from the camera.
        self._pixel_area = 1 / (camera.fx * camera.fy)

    def rays(self, pixel: Tensor, seconds: Sequence[Tensor]) -> RayBundle:
        """Return the rays of pixels, in the camera's frame, at one or more times each.

        Args:
            pixel: (N,) numbers of pixels.
            seconds: float64 times (N,) since the trajectory's start, one tensor for each ray of a pixel.

        Returns:
            The rays of all pixels at their first time, then at their second, and so on, with the metadata that
            :class:`~aenerf_ns.supervision.base.Sampler` asks for.
        """
        in_camera = self._directions.index_select(0, pixel).repeat(len(seconds), 1)
        num_rays, device = len(in_camera), in_camera.device
        return RayBundle(
            origins=torch.zeros((num_rays, 3), device=device),
            directions=in_camera.float(),
            pixel_area=torch.full((num_rays, 1), self._pixel_area, device=device),
            camera_indices=torch.zeros((num_rays, 1), dtype=torch.long, device=device),
            times=torch.cat(list(seconds))[:, None],
            metadata={CAMERA_DIRECTIONS: in_camera},
        )
