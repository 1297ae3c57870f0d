"""The runs of a benchmark."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from aenerf_ns.errors import DataError

Poses = Literal["noise", "colmap"]
Scale = Literal["full", "medium", "tiny"]
Table = Literal["methods", "losses"]
Method = Literal["aenerf", "robust-enerf", "eventnerf", "evnerf", "paev3d", "e2vid-nerf", "nerfacto"]

_FULL_SIZE = ("--width", "346", "--height", "260", "--validation-views", "100", "--test-views", "100")
_SIMULATE = {
    "full": _FULL_SIZE,
    "medium": _FULL_SIZE,
    "tiny": ("--width", "96", "--height", "72", "--validation-views", "20", "--test-views", "20"),
}
# The errors that COLMAP leaves at full size: 0.5 degrees and 4 cm at easy speed, 1.1 degrees and 8 cm at hard speed
# (medians over the sequences of the mean errors, benchmarks/results/estimated_poses_scenes_cpu2.json), from 25 frames a
# second; from 125 they are smaller. They are larger at tiny size, where a pixel covers a larger angle.
_FULL_SIZE_NOISE = ("--pose-noise-degrees", "0.7", "--pose-noise-translation", "0.03")
_NOISE = {
    "full": _FULL_SIZE_NOISE,
    "medium": _FULL_SIZE_NOISE,
    "tiny": ("--pose-noise-degrees", "1.5", "--pose-noise-translation", "0.04"),
}
_STEPS = {"full": 30000, "medium": 4000, "tiny": 1500}
# A CPU renders 100 views of this size in four minutes, so a run of medium scale has no curve over the training.
_MEDIUM_TRAIN = ("--steps-per-eval-all-images", "0")
# Pairs of a batch in the table of losses. They are as many as the methods' own batches hold, at two rays a pair.
_PAIRS = {"full": 1024, "medium": 256, "tiny": 256}

OURS, WITHOUT_CORRECTION, TRUE_POSES, CEILING = (
    "with pose correction",
    "without pose correction",
    "true poses",
    "images, nerfacto",
)
"""The rows of AE-NeRF and nerfacto in the table of methods. The last two are bounds, not rivals: the event method with
true poses, and Nerfstudio's own method on sharp images with true poses."""
POSES_OF_EVENTS = {
    "poses refined by the events, pose correction": ("--poses", "refined"),
    "poses from the events, pose correction": ("--poses", "events"),
}
"""Further rows of AE-NeRF at medium scale: options of aenerf convert, which makes the poses that are then corrected."""

PEERS: dict[Method, str] = {
    "e2vid-nerf": "E2VID + NeRF",
    "eventnerf": "EventNeRF",
    "evnerf": "Ev-NeRF",
    "robust-enerf": "Robust e-NeRF",
    "paev3d": "PAEv3D",
}
"""Other papers' methods in the paper's order, the worst first. PAEv3D stands only in a table of the appendix, between
Robust e-NeRF and AE-NeRF."""
FILTERED = "filter + NeRF"
"""What e2vid-nerf is called on images that no network has reconstructed."""
ON_TRUE_POSES, CORRECTED = ", true poses", ", pose correction"
"""Ends of the names of a peer's rows. The row on estimated poses without correction has neither."""

LOSSES = {
    "l_p + l_r": {"temporal-loss": 0.0, "distortion-loss": 0.0},
    "l_p + l_r + l_g": {"temporal-loss": 1e-3, "distortion-loss": 0.0},
    "l_p + l_r + l_d": {"temporal-loss": 0.0, "distortion-loss": 1e-3},
    "all": {"temporal-loss": 1e-3, "distortion-loss": 1e-3},
}
"""The rows of the paper's table 4: weights of the terms, in its own recipe (aenerf-mlp). All rows have equally many
pairs in a batch. A pair takes two rays, or three with the temporal loss."""

_MODE = "--pipeline.model.camera-optimizer.mode"
_OFF, _SPLINE = (_MODE, "off"), (_MODE, "spline")
SMALL_NERFACTO = (
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
"""Options of nerfacto that give it the proportions of aenerf-small."""


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
        table: the table that the run is a row of: a `Table`, or that of another benchmark.
        row: name of the row.
        dataset: to train and evaluate on.
        method: registered method.
        steps: of the training.
        seed: of the training.
        options: of ns-train.
        images: options of aenerf reconstruct, where the run trains on images made by it.
        convert: options of aenerf convert, where the run trains on the dataset that it makes.
    """

    table: str
    row: str
    dataset: Dataset
    method: str
    steps: int
    seed: int
    options: tuple[str, ...]
    images: tuple[str, ...] = ()
    convert: tuple[str, ...] = ()

    @property
    def true_poses(self) -> bool:
        """Whether the run gets the true poses in place of the estimated ones."""
        return self.row in (TRUE_POSES, CEILING) or self.row.endswith(ON_TRUE_POSES)

    @property
    def name(self) -> str:
        """Name of the files: scene, speed, row, seed and a digest of the other options."""
        unique = digest((self.dataset.name, self.method, str(self.steps), *self.options, *self.images, *self.convert))
        row = self.row.replace(",", "").replace(" + ", "+").replace(" ", "-")
        return f"{scene_name(self.dataset.scene)}_{self.dataset.speed}_{row}_seed{self.seed}_{unique}"


@dataclass(kw_only=True)
class Plan:
    """Scenes x speeds x methods x seeds."""

    scale: Scale = "full"
    """full: 346 x 260 pixels with aenerf, and aenerf-mlp for the losses. medium: the same with aenerf-small and
    aenerf-mlp-small. tiny, for a CPU: 96 x 72 pixels."""
    scenes: tuple[str, ...] = ("room", "object")
    """Scenes as aenerf simulate takes them: built-in ones and files."""
    speeds: tuple[Literal["easy", "hard"], ...] = ("easy", "hard")
    """Constant speed, and 8^sin(2 pi t) times that speed."""
    poses: Poses = "noise"
    """Where the estimated poses come from: true poses with noise, or COLMAP."""
    tables: tuple[Table, ...] = ("methods", "losses")
    """Methods (the paper's tables 1 and 3), losses (its table 4, at hard speed only)."""
    methods: tuple[Method, ...] = ("aenerf", "nerfacto")
    """Whose rows the table of methods has. A method of another paper has three: on estimated poses, on these with our
    pose correction, and on true poses."""
    e2vid_weights: Path | None = None
    """Weights file of E2VID, which makes the images of e2vid-nerf. Without it a filter makes them."""
    seeds: tuple[int, ...] = (42,)
    """Seeds of the trainings."""
    steps: int | None = None
    """Steps of every training. By default 30,000 at full scale, 4000 at medium and 1500 at tiny scale."""
    simulate: str = ""
    """More options of aenerf simulate, as in --simulate="--bayer-pattern RGGB"."""
    train: str = ""
    """More options of the trainings of all methods but nerfacto."""

    def runs(self) -> list[Run]:
        """Return all runs, in the order in which they are made.

        Raises:
            DataError: two scenes have one name.
        """
        names = [scene_name(scene) for scene in self.scenes]
        for name in names:
            if names.count(name) > 1:
                raise DataError("--scenes", f"two scenes have the name {name}", "give one another folder")
        steps = _STEPS[self.scale] if self.steps is None else self.steps
        runs: list[Run] = []
        for seed in self.seeds:
            for scene in self.scenes:
                for speed in self.speeds if "methods" in self.tables else ():
                    runs += [
                        Run("methods", row, self._dataset(scene, speed), name, steps, seed, options, images, convert)
                        for method in self.methods
                        for row, (name, options, images, convert) in self._rows_of(method).items()
                    ]
                if "losses" in self.tables:
                    data, name = self._dataset(scene, "hard"), self._registered("aenerf-mlp")
                    for row, weights in LOSSES.items():
                        rays = (3 if weights["temporal-loss"] else 2) * _PAIRS[self.scale]
                        options = ["--pipeline.datamanager.train-num-rays-per-batch", str(rays)]
                        for loss, weight in weights.items():
                            options += [f"--pipeline.model.loss-coefficients.{loss}", str(weight)]
                        runs.append(Run("losses", row, data, name, steps, seed, (*self._train_options(), *options)))
        return runs

    def _train_options(self) -> tuple[str, ...]:
        return (*(_MEDIUM_TRAIN if self.scale == "medium" else ()), *shlex.split(self.train))

    def _dataset(self, scene: str, speed: str) -> Dataset:
        # COLMAP gets frames at the paper's rate.
        estimated = _NOISE[self.scale] if self.poses == "noise" else ("--poses", "colmap", "--frame-rate", "250")
        # Otherwise all paths of one duration would have the same errors, and a mean over scenes would hold one draw.
        seed = str(int(digest((scene_name(scene), speed)), 16))
        options = (*_SIMULATE[self.scale], "--seed", seed, *estimated, *shlex.split(self.simulate))
        return Dataset(scene, speed, self.poses, options)

    def _registered(self, method: str) -> str:
        return method if self.scale == "full" else f"{method}-small"

    def _rows_of(self, method: Method) -> dict[str, tuple[str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]]:
        """Return method and options of ns-train, aenerf reconstruct and aenerf convert by row."""
        if method == "nerfacto":
            return {CEILING: (method, () if self.scale == "full" else SMALL_NERFACTO, (), ())}
        train = self._train_options()
        off, spline = (*train, *_OFF), (*train, *_SPLINE)
        images: tuple[str, ...] = ()
        if method == "aenerf":
            options = {OURS: train, WITHOUT_CORRECTION: off, TRUE_POSES: off}
        else:
            name = PEERS[method]
            if method == "e2vid-nerf" and self.e2vid_weights is not None:
                images = ("--weights", str(self.e2vid_weights.resolve()))
            elif method == "e2vid-nerf":
                # The default, stated: without options no images are made.
                name, images = FILTERED, ("--events-per-pixel", "0.35")
            options = {name: off, name + CORRECTED: spline, name + ON_TRUE_POSES: off}
        further = POSES_OF_EVENTS if method == "aenerf" and self.scale == "medium" else {}
        registered = self._registered(method)
        return {
            **{row: (registered, words, images, ()) for row, words in options.items()},
            **{row: (registered, train, (), words) for row, words in further.items()},
        }


def scene_name(scene: str) -> str:
    """Return the short name of a scene: a built-in name, or for a file its stem, or the folder of a scene.json."""
    path = Path(scene)
    return path.resolve().parent.name if path.name == "scene.json" else path.stem


def digest(words: Sequence[str]) -> str:
    """Return eight hexadecimal digits that differ for other words."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
