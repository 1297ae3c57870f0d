"""Metrics of reference views one by one, which the framework averages without keeping them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from PIL import Image
from torch import Tensor

from aenerf_ns.evaluation.poses import camera_speeds
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.progress import progress_bar

IMAGE_METRICS = ("psnr", "ssim", "lpips")
"""Image-quality metrics. All others are timings."""


@torch.no_grad()
def measure_views(
    model: AENeRFModel,
    views: Iterable[tuple[Cameras, dict[str, Any]]],
    names: Sequence[str],
    output: Path | None = None,
    prefix: str = "",
) -> list[dict[str, float]]:
    """Render reference views and compare them with their images.

    Args:
        model: in evaluation mode.
        views: single cameras (1,) with their batches.
        names: of the views, in their order. The pictures are named after them.
        output: folder for pictures, or None.
        prefix: of the pictures' names.

    Returns:
        The metrics of each view, and ``num_rays_per_sec`` and ``fps`` as the framework has them.
    """
    if output is not None:
        output.mkdir(exist_ok=True, parents=True)
    measured = []
    with progress_bar() as progress:
        task = progress.add_task("Evaluating views", total=len(names))
        for name, (camera, batch) in zip(names, views, strict=True):
            began = perf_counter()
            outputs = model.get_outputs_for_camera(camera)
            metrics, pictures = model.get_image_metrics_and_images(outputs, batch)
            if output is not None:
                for kind, picture in pictures.items():
                    to_image(picture).save(output / f"{prefix}_{kind}_{name}.png")
            seconds = perf_counter() - began
            num_rays = int(camera.height) * int(camera.width)
            measured.append({**metrics, "num_rays_per_sec": num_rays / seconds, "fps": 1 / seconds})
            progress.advance(task)
    return measured


def average_metrics(metrics: Sequence[dict[str, float]], with_deviations: bool) -> dict[str, float]:
    """Compute the mean of each metric of views, and its standard deviation if asked for and if there are two views."""
    averages = {}
    for name in metrics[0]:
        deviation, mean = torch.std_mean(torch.tensor([view[name] for view in metrics]))
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
    return [str(file.relative_to(run.data) if file.is_relative_to(run.data) else file) for file in files]


def describe_views(
    run: TrainedRun, placed: Sequence[dict[str, float]], refined: Sequence[dict[str, float]] | None
) -> list[dict[str, Any]]:
    """Describe each reference view in plain values.

    Args:
        run: with its views.
        placed: metrics of each view from where its camera is placed.
        refined: the same from photometrically refined poses, or None where they were not refined.

    Returns:
        Of each view its ``file`` (:func:`view_files`), and its metrics ``placed`` and
        ``refined``. Of a view on the trajectory also ``time_ns``, on the clock of the events, and of the corrected
        trajectory then ``camera_speed``, in units of the recording per second, and
        ``camera_turn_rate_degrees``, per second. They are None of a view off the trajectory.
    """
    assert run.views is not None
    seconds = run.views.reference_seconds
    on_trajectory = seconds.isfinite()
    speeds, turn_rates = camera_speeds(run.model.camera_optimizer, run.scene, seconds.nan_to_num(0.0))
    start = run.scene.trajectory.start
    views = []
    for index, file in enumerate(view_files(run)):
        timed = bool(on_trajectory[index])
        view: dict[str, Any] = {
            "file": file,
            "time_ns": start + round(float(seconds[index]) * 1e9) if timed else None,
            "camera_speed": float(speeds[index]) if timed else None,
            "camera_turn_rate_degrees": float(turn_rates[index]) if timed else None,
            "placed": _image_metrics(placed[index]),
        }
        if refined is not None:
            view["refined"] = _image_metrics(refined[index])
        views.append(view)
    return views


def _image_metrics(metrics: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if name in IMAGE_METRICS}
