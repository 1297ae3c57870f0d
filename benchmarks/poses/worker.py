"""Train by ns-train, follow the poses and the loss, and evaluate with test poses placed and refined.

    python benchmarks/poses/worker.py RESULT EVALUATION METHOD OPTIONS

``EVALUATION`` is "placed" or "refined": whether the test poses are refined photometrically, too. Writes the file
``RESULT``.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts import train as ns_train
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.alignment import align, pose_errors
from aenerf_ns.camera.trajectory import homogeneous

LAGS = (0.1, 0.2, 0.4, 0.8)
"""Seconds between two poses whose relative error is measured."""
_PARTS = 30
"""Parts of a run after which the poses are compared with the true ones."""
_GRID = 5
"""Points across and down the picture that a relative error is measured on."""


def pixel_errors(poses: Tensor, reference: Tensor, seconds: Tensor, camera: dict[str, float]) -> dict[str, float]:
    """Return how far scene points seem to move between two poses that are some time apart, against the truth.

    Events tell of motion between nearby times, and of nothing else. So an error that all poses share is none here.

    Args:
        poses: (N, 3, 4) camera-to-world, OpenCV axes.
        reference: (N, 3, 4) true poses at the same times, in the same units.
        seconds: (N,) increasing times.
        camera: ``fx``, ``fy``, ``width``, ``height`` in pixels and the ``depth`` of the scene in the poses' unit.

    Returns:
        For each of :data:`LAGS`, the root mean square distance in pixels between points that are projected by the true
        and by the given relative motion. The points lie on a grid of pixels at the scene's depth. Points that leave the
        picture do not count. NaN where there are none.
    """
    aligned = homogeneous(align(poses, reference)(poses.double()))
    true = homogeneous(reference.double())
    width, height, depth = camera["width"], camera["height"], camera["depth"]
    focal = torch.tensor([camera["fx"], camera["fy"]], dtype=torch.float64)
    grid = (torch.arange(_GRID, dtype=torch.float64) + 0.5) / _GRID - 0.5
    x, y = torch.meshgrid(grid * width, grid * height, indexing="xy")
    pixels = torch.stack([x.flatten(), y.flatten()], -1)
    points = depth * torch.cat([pixels / focal, torch.ones(_GRID**2, 1, dtype=torch.float64)], -1)
    half = torch.tensor([width / 2, height / 2], dtype=torch.float64)

    errors = {}
    for lag in LAGS:
        # A microsecond less, because sums of seconds are rounded.
        later = torch.searchsorted(seconds, seconds + (lag - 1e-6))
        first = (later < len(seconds)).nonzero()[:, 0]
        later = later[first]
        expected, found = (_moved(points, source[first], source[later]) for source in (true, aligned))
        offset = focal * (found[..., :2] / found[..., 2:] - expected[..., :2] / expected[..., 2:])
        in_front = torch.minimum(expected[..., 2], found[..., 2]) > 0.1 * depth
        in_picture = (focal * expected[..., :2] / expected[..., 2:]).abs() < half
        squares = offset[in_front & in_picture.all(-1)].square().sum(-1)
        errors[str(lag)] = float(squares.mean().sqrt()) if len(squares) else math.nan
    return errors


def _moved(points: Tensor, poses: Tensor, later: Tensor) -> Tensor:
    """Return points (K, 3), seen from each of (N, 4, 4) poses, as (N, K, 3) in the frames of later poses (N, 4, 4)."""
    motion = torch.linalg.inv(later) @ poses
    return points @ motion[:, :3, :3].mT + motion[:, None, :3, 3]


def _camera(data: Path) -> dict[str, float]:
    """Return the camera of a simulated dataset and the scene's depth: the median over the training views."""
    meta = json.loads((data / "transforms.json").read_text("utf8"))
    depths = []
    for frame in meta["frames"]:
        if "depth_file_path" in frame and frame["file_path"] in meta["train_filenames"]:
            thousandths = np.asarray(Image.open(data / frame["depth_file_path"]), np.float64)
            depths.append(thousandths[thousandths > 0] / 1000)
    return {
        "fx": meta["fl_x"], "fy": meta["fl_y"], "width": meta["w"], "height": meta["h"],
        "depth": float(np.median(np.concatenate(depths))),
    }  # fmt: skip


class _Record:
    """Losses of every step, and errors of the poses during a training on a simulated dataset."""

    def __init__(self, trainer: Trainer) -> None:
        self._pipeline = trainer.pipeline
        self._camera = _camera(trainer.pipeline.datamanager.get_datapath())
        self._losses: list[Tensor] = []
        self._poses: dict[int, dict[str, Any]] = {}
        compute = trainer.pipeline.get_train_loss_dict

        def get_train_loss_dict(step: int) -> Any:
            outputs, losses, metrics = compute(step)
            self._losses.append(losses["reconstruction_loss"].detach())
            return outputs, losses, metrics

        trainer.pipeline.get_train_loss_dict = get_train_loss_dict
        every = max(trainer.config.max_num_iterations // _PARTS, 1)
        trainer.callbacks.append(
            TrainingCallback(
                [TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._follow, update_every_num_iters=every
            )
        )

    def _follow(self, step: int) -> None:
        self._poses[step] = self._errors()

    def _errors(self) -> dict[str, Any]:
        correction, scene = self._pipeline.model.camera_optimizer, self._pipeline.datamanager.train_dataset.scene
        _, corrected, reference = (scene.to_recording(poses) for poses in correction.compared_poses())
        errors = pose_errors(corrected, reference)
        seconds = correction._compared_seconds.cpu()
        return {
            "degrees": errors["rotation_error_degrees"],
            "translation": errors["translation_error"],
            "pixels": pixel_errors(corrected, reference, seconds, self._camera),
        }

    def results(self) -> dict[str, Any]:
        """Return the curves: the mean loss of each part of the run, and the errors of the poses."""
        losses = torch.stack(self._losses)
        parts = losses.split(max(len(losses) // _PARTS, 1))
        return {
            "loss": [float(part.mean()) for part in parts],
            "plateau_left_at": plateau_left_at(losses),
            "poses": {**{str(step): errors for step, errors in self._poses.items()}, "end": self._errors()},
        }


def plateau_left_at(losses: Tensor) -> int:
    """Return the step at which the loss has fallen half of the way from its start to its end, by the logarithm.

    The start is the mean of the first tenth of the run, the end the mean of the last tenth.
    """
    window = max(len(losses) // 50, 1)
    smooth = torch.nn.functional.avg_pool1d(losses[None], window, 1)[0].log()
    tenth = max(len(smooth) // 10, 1)
    half = (smooth[:tenth].mean() + smooth[-tenth:].mean()) / 2
    return int((smooth > half).nonzero()[-1]) + window


def _evaluate(config: Path, refined: bool) -> dict[str, Any]:
    """Return the metrics of the test views, as ns-eval does, with their poses placed and, if wanted, refined."""
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    pipeline.config.refine_test_poses = refined
    placed = pipeline.get_average_eval_image_metrics()
    return {"refined": placed.pop("refined_test_poses"), "placed": placed} if refined else {"placed": placed}


def main() -> None:
    """Train and evaluate."""
    result, refined = Path(sys.argv.pop(1)), sys.argv.pop(1) == "refined"
    record: dict[str, Any] = {}
    train = Trainer.train

    def recorded(trainer: Trainer) -> None:
        curves = _Record(trainer)
        begin = time.perf_counter()
        train(trainer)
        record["train_seconds"] = time.perf_counter() - begin
        record.update(curves.results())
        record["config"] = trainer.base_dir / "config.yml"

    Trainer.train = recorded
    ns_train.entrypoint()
    record.update(_evaluate(record.pop("config"), refined))
    result.write_text(json.dumps(record, indent=2) + "\n", "utf8")


if __name__ == "__main__":
    main()
