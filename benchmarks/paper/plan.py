"""The runs of a benchmark."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from aenerf_ns.errors import DataError

Poses = Literal["noise", "colmap"]
Scale = Literal["full", "tiny"]
Table = Literal["methods", "losses"]
Method = Literal["aenerf", "robust-enerf", "eventnerf", "evnerf", "paev3d", "e2vid-nerf", "nerfacto"]

_SIMULATE = {
    "full": ("--width", "346", "--height", "260", "--validation-views", "100", "--test-views", "100"),
    "tiny": ("--width", "96", "--height", "72", "--validation-views", "20", "--test-views", "20"),
}
# At full size about the errors that COLMAP leaves on the benchmark's scenes: 0.5 degrees and 4 cm at easy speed, 1.1
# degrees and 8 cm at hard (medians over the sequences of the mean errors,
# benchmarks/results/estimated_poses_scenes_cpu2.json). Larger at tiny size, where a pixel covers a larger angle.
_NOISE = {
    "full": ("--pose-noise-degrees", "0.7", "--pose-noise-translation", "0.03"),
    "tiny": ("--pose-noise-degrees", "1.5", "--pose-noise-translation", "0.04"),
}
_STEPS = {"full": 30000, "tiny": 1500}
# Pairs of a batch in the table of losses. They are as many as the methods' own batches hold, at two rays a pair.
_PAIRS = {"full": 4096, "tiny": 512}

OURS, WITHOUT_CORRECTION, TRUE_POSES, CEILING = (
    "with pose correction",
    "without pose correction",
    "true poses",
    "images, nerfacto",
)
"""The rows of AE-NeRF and nerfacto in the table of methods. The last two are bounds, not rivals: the event method with
true poses, and Nerfstudio's own method on sharp images with true poses."""

PEERS: dict[Method, str] = {
    "e2vid-nerf": "E2VID + NeRF",
    "eventnerf": "EventNeRF",
    "evnerf": "Ev-NeRF",
    "robust-enerf": "Robust e-NeRF",
    "paev3d": "PAEv3D",
}
"""Other papers' methods in the paper's order, the worst first. PAEv3D stands only in a table of the appendix, between
Robust e-NeRF and AE-NeRF."""
HIGH_PASS = "high-pass + NeRF"
"""What e2vid-nerf is called on images that no network has reconstructed."""
ON_TRUE_POSES, CORRECTED = ", true poses", ", pose correction"
"""Ends of the names of a peer's rows. The row on estimated poses without correction has neither."""

LOSSES = {
    "l_p + l_r": {"temporal-loss": 0.0, "distortion-loss": 0.0},
    "l_p + l_r + l_g": {"temporal-loss": 1e-3, "distortion-loss": 0.0},
    "l_p + l_r + l_d": {"temporal-loss": 0.0, "distortion-loss": 1e-3},
    "all": {"temporal-loss": 1e-3, "distortion-loss": 1e-3},
}
"""The rows of the paper's table 4: weights of the terms. All rows have equally many pairs in a batch. A pair takes two
rays, or three with the temporal loss."""

_MODE = "--pipeline.model.camera-optimizer.mode"
_OFF, _SPLINE = (_MODE, "off"), (_MODE, "spline")
# nerfacto in the proportions of aenerf-small.
_SMALL_NERFACTO = (
    "--pipeline.datamanager.train-num-rays-per-batch", "1024",
    "--pipeline.model.num-levels", "8",
    "--pipeline.model.max-res", "256",
    "--pipeline.model.log2-hashmap-size", "15",
    "--pipeline.model.hidden-dim", "32",
    "--pipeline.model.hidden-dim-color", "32",
    "--pipeline.model.num-proposal-iterations", "1",
    "--pipeline.model.num-proposal-samples-per-ray", "48",
    "--pipeline.model.num-nerf-samples-per-ray", "24",
    "--pipeline.model.proposal-weights-anneal-max-num-iters", "200",
)  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """A simulated dataset.

    Attributes:
        scene: name or file, as aenerf simulate takes it.
        speed: "easy" or "hard".
        poses: where the estimated poses come from, "noise" or "colmap".
        options: of aenerf simulate.
    """

    scene: str
    speed: str
    poses: Poses
    options: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the folder: scene, speed, poses and a digest of the options."""
        return f"{scene_name(self.scene)}_{self.speed}_{self.poses}_{digest((self.scene, *self.options))}"

    @property
    def command(self) -> tuple[str, ...]:
        """Arguments of aenerf simulate without the output."""
        return ("--scene", self.scene, "--speed", self.speed, *self.options)


@dataclass(frozen=True)
class Run:
    """A training and its evaluation.

    Attributes:
        table: the table that the run is a row of.
        row: name of the row.
        dataset: to train and evaluate on.
        method: registered method.
        steps: of the training.
        seed: of the training.
        options: of ns-train.
        images: options of aenerf reconstruct, where the run trains on images made by it.
    """

    table: Table
    row: str
    dataset: Dataset
    method: str
    steps: int
    seed: int
    options: tuple[str, ...]
    images: tuple[str, ...] = ()

    @property
    def true_poses(self) -> bool:
        """Whether the run gets the true poses in place of the estimated ones."""
        return self.row in (TRUE_POSES, CEILING) or self.row.endswith(ON_TRUE_POSES)

    @property
    def name(self) -> str:
        """Name of the files: scene, speed, row, seed and a digest of the other options."""
        unique = digest((self.dataset.name, self.method, str(self.steps), *self.options, *self.images))
        row = self.row.replace(",", "").replace(" + ", "+").replace(" ", "-")
        return f"{scene_name(self.dataset.scene)}_{self.dataset.speed}_{row}_seed{self.seed}_{unique}"


def plan(
    scenes: Sequence[str],
    speeds: Sequence[str],
    poses: Poses,
    tables: Sequence[Table],
    seeds: Sequence[int],
    scale: Scale,
    steps: int | None = None,
    simulate: Sequence[str] = (),
    train: Sequence[str] = (),
    methods: Sequence[Method] = ("aenerf", "nerfacto"),
    e2vid_weights: Path | None = None,
) -> list[Run]:
    """Return all runs, in the order in which they are made.

    Args:
        scenes: names or files, as aenerf simulate takes them.
        speeds: "easy" and "hard".
        poses: where the estimated poses come from.
        tables: "methods" for the paper's tables 1 and 3; "losses" for its table 4, at hard speed only.
        seeds: of the trainings.
        scale: "full" or, for a CPU, "tiny".
        steps: of every training; 30,000 or 1500 by default.
        simulate: more options of aenerf simulate.
        train: more options of the trainings of all methods but nerfacto.
        methods: whose rows the table of methods has.
        e2vid_weights: weights file of E2VID; without it the high-pass filter makes the images of e2vid-nerf.

    Raises:
        DataError: two scenes have one name.
    """
    for scene in scenes:
        if [scene_name(other) for other in scenes].count(scene_name(scene)) > 1:
            raise DataError("--scenes", f"two scenes have the name {scene_name(scene)}", "give one another folder")

    def dataset(scene: str, speed: str) -> Dataset:
        estimated = _NOISE[scale] if poses == "noise" else ("--poses", "colmap")
        return Dataset(scene, speed, poses, (*_SIMULATE[scale], *estimated, *simulate))

    length, runs = _STEPS[scale] if steps is None else steps, []
    end = "-small" if scale == "tiny" else ""
    images: tuple[str, ...] = ("--method", "high-pass")
    if e2vid_weights is not None:
        images = ("--method", "e2vid", "--weights", str(e2vid_weights.resolve()))

    def rows_of(method: Method) -> dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]]:
        """Return method, options of ns-train and options of aenerf reconstruct by row."""
        if method == "nerfacto":
            return {CEILING: (method, _SMALL_NERFACTO if scale == "tiny" else (), ())}
        off, spline = (*train, *_OFF), (*train, *_SPLINE)
        if method == "aenerf":
            options = {OURS: tuple(train), WITHOUT_CORRECTION: off, TRUE_POSES: off}
            return {row: (method + end, words, ()) for row, words in options.items()}
        of_images = images if method == "e2vid-nerf" else ()
        name = HIGH_PASS if of_images and e2vid_weights is None else PEERS[method]
        options = {name: off, name + CORRECTED: spline, name + ON_TRUE_POSES: off}
        return {row: (method + end, words, of_images) for row, words in options.items()}

    for seed in seeds:
        for scene in scenes:
            for speed in speeds if "methods" in tables else ():
                runs += [
                    Run("methods", row, dataset(scene, speed), name, length, seed, options, of_images)
                    for method in methods
                    for row, (name, options, of_images) in rows_of(method).items()
                ]
            if "losses" in tables:
                data = dataset(scene, "hard")
                for row, weights in LOSSES.items():
                    rays = (3 if weights["temporal-loss"] else 2) * _PAIRS[scale]
                    options = ["--pipeline.datamanager.train-num-rays-per-batch", str(rays)]
                    for loss, weight in weights.items():
                        options += [f"--pipeline.model.loss-coefficients.{loss}", str(weight)]
                    runs.append(Run("losses", row, data, f"aenerf{end}", length, seed, (*train, *options)))
    return runs


def scene_name(scene: str) -> str:
    """Return the short name of a scene: a built-in name, or for a file its stem, or the folder of a scene.json."""
    path = Path(scene)
    return path.resolve().parent.name if path.name == "scene.json" else path.stem


def digest(words: Sequence[str]) -> str:
    """Return eight hexadecimal digits that differ for other words."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
