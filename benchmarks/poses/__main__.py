"""Measure how well poses are corrected, beside true poses at the same steps, with several seeds.

    python -m benchmarks.scenes.build --output scenes
    python -m benchmarks.poses --scenes-folder scenes --work work --output benchmarks/results/poses_cpu2.json
    python -m benchmarks.poses --split choose --variants density " --pipeline.model.average-init-density 3" ...

Each recording is trained with its wrong poses, with these refined by its events, with poses found from its events alone
and, as a control, with its true poses. Every variant of the settings is trained on the same recordings with the same
seeds. The runs are made as those of ``benchmarks.paper``, in the folder ``--work``, where finished runs are found
again. See ``scenes.py`` for the recordings.
"""

from __future__ import annotations

import json
import math
import os
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from aenerf_ns.camera.alignment import align, pose_errors
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.progress import progress_bar
from benchmarks.paper.plan import ON_TRUE_POSES, Dataset, Run
from benchmarks.paper.running import Runner
from benchmarks.poses.scenes import SCENES, Split, scene_argument
from benchmarks.runs import run_benchmark, write_result

_OFF = ("--pipeline.model.camera-optimizer.mode", "off")
# Row of the run, options of ns-train, and options of aenerf convert.
_CASES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "noise, corrected": ("corrected", (), ()),
    "noise, not corrected": ("not corrected", _OFF, ()),
    "noise, refined, corrected": ("refined, corrected", (), ("--poses", "refined")),
    "from nothing, corrected": ("from nothing, corrected", (), ("--poses", "events")),
    "true poses, corrected": (f"corrected{ON_TRUE_POSES}", (), ()),
    "true poses": (f"not corrected{ON_TRUE_POSES}", _OFF, ()),
}
_DEFAULT = "default"
LAGS = (0.1, 0.2, 0.4, 0.8)
"""Seconds between two poses whose relative error is measured."""
_GRID = 5
"""Points across and down the picture that a relative error is measured on."""


@dataclass
class Poses:
    """Measure the correction of poses."""

    output: Path
    """JSON file to write after each training."""
    work: Path
    """Folder for datasets, runs and logs."""
    scenes_folder: Path
    """Folder of ``benchmarks.scenes.build``."""
    split: Split | Literal["all"] = "all"
    """choose: the recordings that settings are chosen on. report: the others."""
    scenes: tuple[str, ...] = ()
    """Names of recordings, in place of a split."""
    cases: tuple[str, ...] = tuple(_CASES)
    """Poses to train with, and whether they are corrected."""
    seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of the trainings."""
    method: str = "aenerf-small"
    """Registered method."""
    steps: int = 1200
    """Steps of each training."""
    variants: dict[str, str] = field(default_factory=dict)
    """More options of ns-train by the name of a variant. The method's defaults are always measured beside them."""
    jobs: int = 1
    """Trainings at a time, each with one thread."""

    def main(self) -> None:
        """Simulate and train whatever is missing, and write the table."""
        names = self.scenes or tuple(name for name, scene in SCENES.items() if self.split in ("all", scene.split))
        for option, chosen, known in (("--scenes", names, SCENES), ("--cases", self.cases, _CASES)):
            if unknown := set(chosen) - set(known):
                raise DataError(option, f"unknown: {', '.join(sorted(unknown))}", f"choose among {', '.join(known)}")
        os.environ["OMP_NUM_THREADS"] = "1"
        variants = {_DEFAULT: "", **self.variants}
        datasets = {name: self._dataset(name) for name in names}
        settings = list(product(self.seeds, names, self.cases, variants))
        described = {
            name: {"about": SCENES[name].about, "simulate": shlex.join(datasets[name].command)} for name in names
        }
        about = {"method": self.method, "steps": self.steps, "variants": variants, "scenes": described}
        runner, runs, failed = Runner(self.work, "cpu"), [], []

        def measure(seed: int, name: str, case: str, variant: str) -> dict[str, Any] | None:
            setting = {"scene": name, "case": case, "variant": variant, "seed": seed}
            row, of_case, convert = _CASES[case]
            options = (*of_case, *shlex.split(variants[variant]))
            run = Run("poses", row, datasets[name], self.method, self.steps, seed, options, convert=convert)
            try:
                made = runner.make(run)
            except DataError as error:
                # Such as a recording whose poses are not found. The others go on.
                failed.append({**setting, "error": str(error)})
                return None
            if made is None:
                return None
            placed = made["results"]
            refined = placed.pop("refined_test_poses")
            # The views would be most of the file. They stay in the folder of the runs.
            placed.pop("views", None)
            return {**setting, "placed": placed, "refined": refined, "poses": self._pose_errors(run)}

        with progress_bar() as progress, ThreadPoolExecutor(self.jobs) as pool:
            finished = pool.map(lambda chosen: measure(*chosen), settings)
            for measured in progress.track(finished, total=len(settings), description="Poses"):
                if measured is not None:
                    runs.append(measured)
                result = {**about, "table": table(runs), "runs": runs, "failed": failed}
                write_result(self.output, result, show=False)

    def _dataset(self, name: str) -> Dataset:
        scene = SCENES[name]
        argument = scene_argument(scene.scene, self.scenes_folder, self.work / "scenes")
        return Dataset(argument, scene.speed, scene.poses, scene.options)

    def _pose_errors(self, run: Run) -> dict[str, Any]:
        """Return the errors of the poses at the end of a run."""
        data = self.work / "datasets" / run.dataset.name
        truth = read_tum_trajectory(data / "trajectory_ground_truth.txt")
        corrected = read_tum_trajectory(self.work / "runs" / run.name / "corrected.txt")
        times = corrected.knots_covered_by(truth)
        poses, reference = corrected.interpolate(times), truth.interpolate(times)
        errors = pose_errors(poses, reference)
        return {
            "degrees": errors["rotation_error_degrees"],
            "translation": errors["translation_error"],
            "pixels": pixel_errors(poses, reference, (times - times[0]).double() * 1e-9, _camera(data)),
        }


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
        # The points as seen from each of the first poses, in the frame of the later pose: (N, K, 3).
        motions = (torch.linalg.inv(source[later]) @ source[first] for source in (true, aligned))
        expected, found = (points @ motion[:, :3, :3].mT + motion[:, None, :3, 3] for motion in motions)
        offset = focal * (found[..., :2] / found[..., 2:] - expected[..., :2] / expected[..., 2:])
        in_front = torch.minimum(expected[..., 2], found[..., 2]) > 0.1 * depth
        in_picture = (focal * expected[..., :2] / expected[..., 2:]).abs() < half
        squares = offset[in_front & in_picture.all(-1)].square().sum(-1)
        errors[str(lag)] = float(squares.mean().sqrt()) if len(squares) else math.nan
    return errors


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


def table(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each scene, case and variant: means over the seeds, and their spread.

    A row's ``less_than_true_poses`` is the mean of the differences, seed by seed, to true poses without correction in
    the same variant; its ``more_than_default`` the mean of the differences to the default settings in the same case.
    """
    of = {(run["scene"], run["case"], run["variant"], run["seed"]): run for run in runs}
    rows = []
    for scene, case, variant in dict.fromkeys((run["scene"], run["case"], run["variant"]) for run in runs):
        own = {seed: run for (s, c, v, seed), run in of.items() if (s, c, v) == (scene, case, variant)}
        row: dict[str, Any] = {"scene": scene, "case": case, "variant": variant, "seeds": sorted(own)}
        for poses in ("placed", "refined"):
            values = {seed: run[poses]["psnr"] for seed, run in own.items()}
            row[f"psnr_{poses}"] = _summary(list(values.values()))
            for name, sign, other in (
                ("less_than_true_poses", -1, (scene, "true poses", variant)),
                ("more_than_default", 1, (scene, case, _DEFAULT)),
            ):
                others = {seed: of[(*other, seed)][poses]["psnr"] for seed in values if (*other, seed) in of}
                if others and other != (scene, case, variant):
                    row[f"psnr_{poses}_{name}"] = _summary([sign * (values[seed] - others[seed]) for seed in others])
        ends = [run["poses"] for run in own.values()]
        row["degrees"] = _summary([end["degrees"] for end in ends])
        row["translation"] = _summary([end["translation"] for end in ends])
        row["pixels"] = {lag: _summary([end["pixels"][lag] for end in ends]) for lag in ends[0]["pixels"]}
        rows.append(row)
    return rows


def _summary(values: list[float]) -> dict[str, float]:
    return {"mean": math.fsum(values) / len(values), "spread": max(values) - min(values)}


if __name__ == "__main__":
    run_benchmark(Poses)
