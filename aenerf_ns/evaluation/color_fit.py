"""Fitting the color correction of a run on reference views."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.method.color_correction import NoColorCorrection
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol


class ColorFit:
    """Fits the color correction of a run on pixels of its protocol's reference views, the same in every run.

    Without such views, the percentiles of the training cameras' renderings are stretched over the display's range.
    """

    def __init__(self, run: TrainedRun) -> None:
        self._run = run
        # Chosen once: otherwise every fit would read the images again.
        self._pixels: tuple[Cameras, Tensor, Tensor, Tensor | None] | None = None
        # The sign of the slope that was printed last.
        self._was_reversed: bool | None = None
        if run.model.color_correction.protocol == "affine-test":
            CONSOLE.print(
                "[yellow]Color correction affine-test is fitted on the test views themselves: only to compare with "
                "figures that were made so."
            )

    def fit(self, share: float = 1.0) -> None:
        """Fit the color correction on a share of the configured number of pixels. A share below 1 makes a rough fit."""
        model, correction = self._run.model, self._run.model.color_correction
        if isinstance(correction, NoColorCorrection):
            return
        if self._pixels is None:
            self._pixels = self._choose_pixels(correction.split)
        cameras, view, coordinates, radiance = self._pixels
        count = max(round(share * len(view)), 1)
        # Reference views are carried over to the frame that the corrected poses have at this step.
        cameras = replace(cameras, camera_to_worlds=model.camera_optimizer.apply_to_camera(cameras))
        rays = cameras.generate_rays(view[:count], coords=coordinates[:count])
        log_radiance = model.render_rays(rays, "log_radiance")[0]
        if radiance is None:
            correction.stretch(log_radiance)
        else:
            correction.fit(log_radiance, radiance[:count], len(cameras), rough=share < 1)
            if share == 1 and correction.is_reversed != self._was_reversed:
                self._was_reversed = correction.is_reversed
                color = "[yellow]" if correction.is_reversed else ""
                slopes = ", ".join(f"{slope:+.2f}" for slope in correction.scale.tolist())
                CONSOLE.print(f"{color}Color correction: {correction.description}; slope {slopes}.", soft_wrap=True)

    def _choose_pixels(self, split: Literal["val", "test"]) -> tuple[Cameras, Tensor, Tensor, Tensor | None]:
        """Choose random pixels of all reference views of a split, or of the training cameras where there are none.

        Returns:
            the cameras of the views; of each pixel (N, 1) the index of its camera, (N, 2) row and column, and
            (N, channels) the radiance of the reference image, None where there are no reference views.
        """
        references = self._run.read_reference_views(split)
        views = references or self._run.dataset
        generator = torch.Generator().manual_seed(0)
        cameras, device = views.cameras, self._run.device
        count = max(self._run.model.config.color_correction_num_rays, len(views))
        # Every view is drawn as often as the others, in random order, so any part is spread over the views too.
        index = (torch.arange(count) % len(views))[torch.randperm(count, generator=generator)]
        size = torch.cat([cameras.height, cameras.width], -1)[index]
        pixels = (torch.rand(count, 2, generator=generator) * size).long()
        usable = views.usable[pixels[:, 0], pixels[:, 1]]
        index, pixels = index[usable], pixels[usable]
        radiance = None
        if references is not None:
            image = torch.zeros(len(index), 3)
            for view in range(len(views)):
                rows, columns = pixels[index == view].T
                image[index == view] = views.get_image_float32(view)[rows, columns, :3]
            radiance = self._run.model.reference_radiance(image).to(device)
        return cameras.to(device), index[:, None].to(device), (pixels + 0.5).to(device), radiance


def replace_color_correction(run: TrainedRun, protocol: ColorCorrectionProtocol) -> None:
    """Replace the color correction of a run by another protocol, fitted anew on the run's data."""
    run.model.color_correction = run.model.new_color_correction(protocol).to(run.device)
    ColorFit(run).fit()
