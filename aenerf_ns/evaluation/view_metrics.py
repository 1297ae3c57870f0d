"""Metrics of reference views one by one, which the framework averages without keeping them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from PIL import Image
from torch import Tensor

from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.pose_refinement import refine_camera
from aenerf_ns.evaluation.poses import camera_speeds
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.progress import track

IMAGE_METRICS = ("psnr", "ssim", "lpips")
"""Image-quality metrics. All others are timings."""


@torch.no_grad()
def measure_reference_views(
    run: TrainedRun, output: Path | None = None, refine: bool = False
) -> list[dict[str, float]]:
    """Render the reference views and compare them with their images.

    Args:
        run: with its views.
        output: existing folder for pictures, which are named as ns-eval names them, or None.
        refine: render from photometrically refined poses.

    Returns:
        The metrics of each view, and ``num_rays_per_sec`` and ``fps`` as the framework has them.

    Raises:
        DataError: there are no reference views.
    """
    model = run.model
    if run.views is None:
        raise DataError(run.data, "it has no reference images to evaluate on", "ns-render shows what was reconstructed")
    was_training = model.training
    model.eval()
    names = picture_names(run.views.image_filenames)
    views = FixedIndicesEvalDataloader(input_dataset=run.views, device=run.device)
    measured = []
    for name, (camera, batch) in zip(track(names, "Evaluating views"), views, strict=True):
        if refine:
            camera = refine_camera(model, camera, batch["image"][..., :3], run.views.usable)
        began = perf_counter()
        outputs = model.get_outputs_for_camera(camera)
        metrics, pictures = model.get_image_metrics_and_images(outputs, batch)
        if output is not None:
            for kind, picture in pictures.items():
                to_image(picture).save(output / f"eval_{kind}_{name}.png")
        seconds = perf_counter() - began
        num_rays = int(camera.height) * int(camera.width)
        measured.append({**metrics, "num_rays_per_sec": num_rays / seconds, "fps": 1 / seconds})
    model.train(was_training)
    return measured


def average_metrics(metrics: Sequence[dict[str, float]], with_deviations: bool) -> dict[str, float]:
    """Compute the mean of each metric of views, and its standard deviation if asked for and if there are two views."""
    averages = {}
    for name in metrics[0]:
        values = torch.tensor([view[name] for view in metrics])
        deviation, mean = torch.std_mean(values, correction=min(1, len(values) - 1))
        averages[name] = float(mean)
        if with_deviations and len(metrics) > 1:
            averages[f"{name}_std"] = float(deviation)
    return averages


def to_image(values: Tensor) -> Image.Image:
    """Return the picture of (H, W, 3) display values in [0, 1]."""
    return Image.fromarray((255 * values.detach().clamp(0, 1)).round().byte().cpu().numpy())


def picture_names(files: Sequence[Path]) -> list[str]:
    """Return a name for each view, after its image: the file's name without ending, numbered where two are the same.

    Example:
        >>> picture_names([Path("test/a.png"), Path("test/b.png")])
        ['a', 'b']
        >>> picture_names([Path("left/a.png"), Path("right/a.png")])
        ['0000_a', '0001_a']
    """
    stems = [file.stem for file in files]
    if len(set(stems)) == len(stems):
        return stems
    return [f"{index:04d}_{stem}" for index, stem in enumerate(stems)]


def view_files(run: TrainedRun) -> list[str]:
    """Return the file of each reference view, relative to the dataset where it lies within."""
    files = [] if run.views is None else run.views.image_filenames
    # An event file may stand for its folder. It may be gone by now.
    folder = run.data if run.data.is_dir() else run.data.parent
    return [str(file.relative_to(folder) if file.is_relative_to(folder) else file) for file in files]


def describe_views(
    run: TrainedRun, placed: Sequence[dict[str, float]], refined: Sequence[dict[str, float]] | None
) -> list[dict[str, Any]]:
    """Describe each reference view in plain values: its metrics ``placed`` and, where given, ``refined``.

    Returns:
        Of each view its ``file`` (:func:`view_files`), and its image metrics. Of a view on the trajectory ``time_ns``,
        on the clock of the events, and of the corrected trajectory then ``camera_speed``, in units of the true poses a
        second, and ``camera_turn_rate_degrees``, per second; else they are None.
    """
    assert run.views is not None
    seconds = run.views.reference_seconds
    speeds, turn_rates = camera_speeds(run.model.camera_optimizer, run.scene, seconds.nan_to_num(0.0))
    start = run.scene.trajectory.start
    views = []
    for index, file in enumerate(view_files(run)):
        timed = bool(seconds[index].isfinite())
        view: dict[str, Any] = {
            "file": file,
            "time_ns": start + round(float(seconds[index]) * 1e9) if timed else None,
            "camera_speed": float(speeds[index]) if timed else None,
            "camera_turn_rate_degrees": float(turn_rates[index]) if timed else None,
        }
        for name, metrics in (("placed", placed), ("refined", refined)):
            if metrics is not None:
                view[name] = {metric: metrics[index][metric] for metric in metrics[index] if metric in IMAGE_METRICS}
        views.append(view)
    return views
