"""Pictures of reference views: truth, rendering, error and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from nerfstudio.utils import colormaps
from PIL import Image

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import to_image
from aenerf_ns.progress import track

ERROR_RANGE = 0.25
"""The mean absolute difference of display values in [0, 1] that an error picture shows brightest."""
# Share of the pixels of a depth picture that may lie beyond either end of its range.
_MAX_BEYOND = 0.02
_MAX_CHOSEN = 9


@dataclass(frozen=True)
class ViewPictures:
    """Pictures of a view: the error is black at 0 and brightest at :data:`ERROR_RANGE`.

    ``depth_range`` holds the nearest and the farthest distance that the depth's colors tell apart, in units of the
    recording.
    """

    truth: Image.Image
    rendering: Image.Image
    error: Image.Image
    depth: Image.Image
    depth_range: tuple[float, float]


def choose_views(psnr: Sequence[float]) -> dict[int, str]:
    """Choose the views to show by their PSNR, and say why: the worst, the median and the best one, and every n-th.

    Example:
        >>> choose_views([20.0, 22.0, 21.0])
        {0: 'worst', 2: 'median', 1: 'best'}
    """
    order = np.argsort(psnr, kind="stable")
    chosen = {int(order[0]): "worst"}
    chosen.setdefault(int(order[len(order) // 2]), "median")
    chosen.setdefault(int(order[-1]), "best")
    every = -(-len(order) // (_MAX_CHOSEN - len(chosen)))
    ordinal = f"one of {every}" if every > 3 else {1: "all", 2: "every second", 3: "every third"}[every]
    for index in range(0, len(order), every):
        chosen.setdefault(index, ordinal)
    return chosen


def picture_views(run: TrainedRun, indices: Sequence[int]) -> tuple[list[ViewPictures], list[float]]:
    """Render reference views, by their indices, from where they are placed. The run is in evaluation mode.

    Returns:
        The pictures of each view; and the contrast of each channel over the pixels of these views that have a
        direction: the standard deviation of the rendered log-radiance, before color correction, as a share of that of
        the images.
    """
    model, dataset = run.model, run.views
    assert dataset is not None
    scale = run.scene.scale
    pictures, rendered, true = [], [], []
    for index in track(indices, "Rendering views"):
        outputs = model.get_outputs_for_camera(dataset.cameras[index : index + 1].to(run.device))
        image = dataset.get_image_float32(index).to(run.device)
        pictures.append(_pictures(outputs, model.reference_display(image), scale))
        usable = dataset.usable.to(run.device)
        rendered.append(outputs["log_radiance"][usable].double())
        # The color correction is fitted to the same values.
        true.append(torch.log(model.reference_radiance(image)[usable].double() + 1e-3))
    contrast = torch.cat(rendered).std(0) / torch.cat(true).std(0).clamp_min(1e-9)
    return pictures, contrast.tolist()


def _pictures(outputs: dict[str, Any], truth: torch.Tensor, scale: float) -> ViewPictures:
    rendering, depth = outputs["rgb"], outputs["depth"] / scale
    error = (rendering - truth).abs().mean(-1, keepdim=True)
    seen = depth[outputs["accumulation"] > 0.5].cpu().numpy()
    near, far = np.quantile(seen, [_MAX_BEYOND, 1 - _MAX_BEYOND]).tolist() if len(seen) else (0.0, 1.0)
    errors = colormaps.apply_colormap((error / ERROR_RANGE).clamp(0, 1), colormaps.ColormapOptions("inferno"))
    depths = colormaps.apply_depth_colormap(depth, outputs["accumulation"], near, max(far, near + 1e-9))
    return ViewPictures(to_image(truth), to_image(rendering), to_image(errors), to_image(depths), (near, far))
