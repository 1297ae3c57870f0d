"""Photometric refinement of a test camera's pose: a protocol of evaluation that looks at the test image."""

from __future__ import annotations

from dataclasses import replace

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.method.model import AENeRFModel

NUM_STEPS = 10
_NUM_RAYS = 1024
# Relative to the diagonal of the normal equations (Marquardt), and what an accepted and a rejected step multiply it by.
_FIRST_DAMPING, _LESS, _MORE = 1e-2, 0.2, 10.0
# Added to the diagonal, which is zero where nothing changes with the pose, as in a picture that clips everywhere.
_MIN_DIAGONAL = 1e-9


def refine_camera(model: AENeRFModel, camera: Cameras, image: Tensor, usable: Tensor) -> Cameras:
    """Move a camera so that its rendering fits its image, while field and color correction stay as they are.

    Minimize the squared errors of display values over twists in the camera's frame, by the method of Levenberg and
    Marquardt. The start is where :meth:`PoseCorrection.apply_to_camera` puts the camera. The pixels are the same in
    every step and in every run.

    Args:
        model: in evaluation mode.
        camera: a single perspective camera (1,) of a reference image.
        image: (H, W, 3) reference values in [0, 1].
        usable: (H, W) whether a pixel has a direction.

    Returns:
        The camera (1,) in the scene's frame. It is at the refined pose, or at the first pose where the refined pose has
        the greater error on pixels drawn for the comparison.
    """
    camera = replace(camera, camera_to_worlds=model.camera_optimizer.apply_to_camera(camera), metadata={})
    generator = torch.Generator().manual_seed(0)
    first = homogeneous(camera.camera_to_worlds[0].double())
    fitted = _Pixels(model, camera, image, usable, generator)
    pose, damping = first, _FIRST_DAMPING
    with torch.enable_grad():
        residuals, rays = fitted.residuals(pose)
        error, jacobian = residuals.square().sum(), None
        for _ in range(NUM_STEPS):
            if jacobian is None:
                jacobian = fitted.jacobian(pose, residuals, rays)
                matrix = jacobian.mT @ jacobian
                gradient = jacobian.mT @ residuals.detach().flatten().double()
            diagonal = damping * matrix.diagonal() + _MIN_DIAGONAL
            step = -torch.linalg.solve(matrix + torch.diag(diagonal), gradient)
            tried = pose @ motion_from_twist(step)
            residuals_there, rays_there = fitted.residuals(tried)
            error_there = residuals_there.square().sum()
            if error_there < error:
                pose, residuals, rays, error, jacobian = tried, residuals_there, rays_there, error_there, None
                damping *= _LESS
            else:
                damping *= _MORE
    with torch.no_grad():
        compared = _Pixels(model, camera, image, usable, generator)
        before, after = (compared.residuals(one)[0].square().sum() for one in (first, pose))
    if after < before:
        camera.camera_to_worlds = pose[None, :3].to(camera.camera_to_worlds)
    return camera


class _Pixels:
    """Random pixels of an (H, W, 3) image in [0, 1], and what a camera with its lens renders there at any pose."""

    def __init__(
        self, model: AENeRFModel, camera: Cameras, image: Tensor, usable: Tensor, generator: torch.Generator
    ) -> None:
        self._model = model
        pixels = (torch.rand(_NUM_RAYS, 2, generator=generator) * torch.tensor(image.shape[:2])).long()
        pixels = pixels[usable[pixels[:, 0], pixels[:, 1]]]
        # A sensor of one channel is shown as gray, which is three times the same.
        num_channels = model.sensor.num_channels
        chosen = image[pixels[:, 0], pixels[:, 1]].to(model.device)
        self._reference = model.reference_display(chosen)[:, :num_channels]
        origin = torch.eye(4).to(camera.camera_to_worlds)[None, :3]
        self._rays = replace(camera, camera_to_worlds=origin).generate_rays(
            torch.zeros(len(pixels), 1, dtype=torch.long, device=model.device), coords=(pixels + 0.5).to(model.device)
        )

    def residuals(self, pose: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return how far display values (N, channels) are off at a pose (4, 4), and the rays they depend on.

        The rays are origins and directions (N, 3) in the world.
        """
        pose = pose.to(self._rays.directions)
        origins = pose[:3, 3].repeat(len(self._rays), 1)
        directions = self._rays.directions @ pose[:3, :3].mT
        if torch.is_grad_enabled():
            origins.requires_grad_()
            directions.requires_grad_()
        rays = replace(self._rays, origins=origins, directions=directions)
        shown = self._model.display(self._model(rays)["log_radiance"])
        return shown[:, : self._reference.shape[-1]] - self._reference, (origins, directions)

    def jacobian(self, pose: Tensor, residuals: Tensor, rays: tuple[Tensor, Tensor]) -> Tensor:
        """Return the derivatives (N * channels, 6) of residuals by a twist in the frame of a camera at a pose (4, 4).

        A ray's residuals depend on no other ray, so one backward pass a channel gives the derivatives by every ray.
        """
        rotation = pose[:3, :3]
        own_directions = self._rays.directions.double()
        rows = []
        for channel in residuals.sum(0):
            # By the rays alone: the field's parameters must get no gradients.
            by_origins, by_directions = torch.autograd.grad(channel, rays, retain_graph=True)
            # In the camera's frame: o moves by ρ, and d by ω × d.
            by_motion = by_origins.double() @ rotation
            by_turn = torch.linalg.cross(own_directions, by_directions.double() @ rotation)
            rows.append(torch.cat([by_motion, by_turn], -1))
        return torch.stack(rows, 1).flatten(0, 1)
