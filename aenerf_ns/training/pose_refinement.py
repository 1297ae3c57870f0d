"""Photometric refinement of a test camera's pose: a protocol of evaluation that looks at the test image."""

from __future__ import annotations

from dataclasses import replace

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from aenerf_ns.camera.rotation import motion_from_twist
from aenerf_ns.method.model import AENeRFModel

NUM_STEPS = 100
_NUM_RAYS = 1024
# Radians and scene units of a first step: about a pixel.
_LEARNING_RATE = 2e-3


def refine_camera(model: AENeRFModel, camera: Cameras, image: Tensor) -> Cameras:
    """Move a camera so that its rendering fits its image, while field and colour correction stay as they are.

    Minimise the mean squared error of display values over a twist in the camera's frame. The start is where
    :meth:`PoseCorrection.apply_to_camera` puts the camera. The pixels are the same in every run.

    Args:
        model: in evaluation mode.
        camera: a single camera (1,) of a reference image.
        image: (H, W, 3) reference values in [0, 1].

    Returns:
        The camera (1,) in the scene's frame. It is at the refined pose, or at the first pose where the refined pose has
        the greater error on pixels drawn for the comparison.
    """
    camera = replace(camera, camera_to_worlds=model.camera_optimizer.apply_to_camera(camera), metadata={})
    reference = model.reference_display(image.to(model.device))
    generator = torch.Generator().manual_seed(0)

    def pixels() -> Tensor:
        size = torch.tensor(reference.shape[:2])
        return (torch.rand(_NUM_RAYS, 2, generator=generator) * size).long().to(model.device)

    def error(twist: Tensor, chosen: Tensor) -> Tensor:
        motion = motion_from_twist(twist)[:3].expand(_NUM_RAYS, 3, 4)
        rays = camera.generate_rays(
            torch.zeros(_NUM_RAYS, 1, dtype=torch.long, device=model.device),
            coords=chosen + 0.5,
            camera_opt_to_camera=motion,
        )
        return (model.display(model(rays)["log_radiance"]) - reference[chosen[:, 0], chosen[:, 1]]).square().mean()

    twist = torch.zeros(6, device=model.device, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, NUM_STEPS)
    with torch.enable_grad():
        for _ in range(NUM_STEPS):
            # By the twist alone: the field's parameters must get no gradients.
            (twist.grad,) = torch.autograd.grad(error(twist, pixels()), twist)
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        compared = pixels()
        if error(twist, compared) < error(torch.zeros_like(twist), compared):
            motion = motion_from_twist(twist)
            camera.camera_to_worlds = camera.camera_to_worlds @ motion
    return camera
