"""Make the runs of a benchmark: simulate, train, evaluate, and keep the figures.

All files lie in one folder:

    datasets/DATASET/       simulated datasets
    outputs/RUN/            trained runs, as ns-train writes them
    logs/                   output of the commands
    runs/RUN.json           figures of a run; a run that has them is not made again
    runs/RUN/               pictures of the test views, and the corrected trajectory

Several processes can work on the folder at once, or one after the other. Each skips the run that another is making.
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

from filelock import Timeout

from aenerf_ns.atomic_write import atomic_write
from aenerf_ns.errors import DataError
from aenerf_ns.training.provenance import provenance
from benchmarks.paper.plan import CEILING, Dataset, Run, digest, scene_name
from benchmarks.runs import exclusive, run_command

# Parts of a training. The framework evaluates the validation views after each part but the last, because it counts the
# final step as one less.
_CURVE_PARTS = 5
_CURVE = "Eval Images Metrics Dict (all images)/psnr"
# A path, because the command runs in the benchmark's folder, where the package `benchmarks` is not found.
_WORKER = (sys.executable, str(Path(__file__).with_name("worker.py")))


class Runner:
    """Make runs in the folder of a benchmark, on the device "cuda" or "cpu"."""

    def __init__(self, folder: Path, device: str) -> None:
        self._folder = folder
        self._device = device
        # ns-eval has no option for the device.
        self._variables = {"CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
        self._failed: dict[str, DataError] = {}
        for name in ("datasets", "outputs", "logs", "runs"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def figures(self, run: Run) -> dict[str, Any] | None:
        """Return the figures of a run, or None if the run has not been made."""
        return _read(self._figures_file(run))

    def make(self, run: Run) -> dict[str, Any] | None:
        """Make a run, unless it has been made.

        Returns:
            The figures of the run, or None if another process is making it.

        Raises:
            DataError: a command failed.
        """
        try:
            with exclusive(self._figures_file(run), timeout=0):
                return self.figures(run) or self._make(run)
        except Timeout:
            return None

    def _make(self, run: Run) -> dict[str, Any]:
        # Taken first, because the checkout may change during the run.
        origin = provenance()
        data = self._dataset(run.dataset)
        # Of the dataset as it was simulated, because a conversion may give it a scene box.
        kind = "object" if "scene_box" in json.loads((data / "transforms.json").read_text("utf8")) else "large"
        # A training that was killed leaves files.
        shutil.rmtree(self._folder / "outputs" / run.name, ignore_errors=True)
        for command, options in (("reconstruct", run.images), ("convert", run.convert)):
            if options:
                name = f"{data.name}_{command}_{digest(options)}"
                data = self._make_dataset(name, command, str(data.resolve()), *options)
        training = self._train(run, data)
        evaluation = self._folder / "runs" / run.name / "evaluation.json"
        made = json.loads(evaluation.read_text("utf8"))
        evaluation.unlink()
        if math.isnan(made["results"]["psnr"]):
            # Nerfstudio's own methods train on after their weights are NaN. Those of aenerf-ns stop with an error.
            raise DataError(
                evaluation.parent, "the rendered pictures are NaN", "use another seed, or leave the run out"
            )
        (config,) = (self._folder / "outputs" / run.name).rglob("config.yml")
        figures = {
            "table": run.table,
            "row": run.row,
            "scene": scene_name(run.dataset.scene),
            "kind": kind,
            "speed": run.dataset.speed,
            "poses": "true" if run.true_poses else run.dataset.poses,
            "method": run.method,
            "steps": run.steps,
            "seed": run.seed,
            "device": self._device,
            "simulate": shlex.join(("aenerf", "simulate", *run.dataset.command)),
            "train": shlex.join(training),
            "reconstruct": shlex.join(run.images),
            "convert": shlex.join(run.convert),
            "train_seconds": round(made["train_seconds"]),
            "poses_report": _read(data / "poses_report.json"),
            # JSON has no NaN.
            "results": {name: None if value != value else value for name, value in made["results"].items()},
            "curve": _curve(config.parent),
            **origin,
        }
        with atomic_write(self._figures_file(run)) as partial:
            partial.write_text(json.dumps(figures, indent=2) + "\n", "utf8")
        return figures

    def _figures_file(self, run: Run) -> Path:
        return self._folder / "runs" / f"{run.name}.json"

    def _dataset(self, dataset: Dataset) -> Path:
        # A file is relative to the folder in which the benchmark was started. A built-in scene has no suffix.
        scene = str(Path(dataset.scene).resolve()) if Path(dataset.scene).suffix else dataset.scene
        return self._make_dataset(dataset.name, "simulate", "--scene", scene, *dataset.command[2:])

    def _make_dataset(self, name: str, command: str, *arguments: str) -> Path:
        """Make a dataset by a command of aenerf, unless it has been made, and return its folder.

        If another process is making it, this one waits.
        """
        if name in self._failed:
            # Each run of this dataset would make it again and fail again.
            raise self._failed[name]
        folder, log = self._folder / "datasets" / name, self._folder / "logs" / f"{name}.log"
        words = (str(Path(sys.executable).with_name("aenerf")), command, *arguments, "--output", str(folder.resolve()))
        try:
            with exclusive(folder):
                if not folder.exists():
                    run_command(words, log, self._folder, **self._variables)
        except DataError as error:
            self._failed[name] = error
            raise
        return folder

    def _train(self, run: Run, data: Path) -> tuple[str, ...]:
        """Train, evaluate, and return the command of the training, without the folders of this machine."""
        words = [
            run.method, "--machine.device-type", self._device, "--machine.seed", str(run.seed), "--vis", "tensorboard",
            "--experiment-name", run.name, "--output-dir", "outputs", "--max-num-iterations", str(run.steps),
            "--steps-per-eval-all-images", str(max(run.steps // _CURVE_PARTS, 1)),
        ]  # fmt: skip
        if run.row == CEILING:
            # The framework's implementation that needs no CUDA extension.
            words += [
                "--pipeline.model.implementation", "torch",
                "--pipeline.model.camera-optimizer.mode", "off", "--pipeline.model.use-appearance-embedding", "False",
            ]  # fmt: skip
            if self._device == "cpu":
                # Renders the same pictures faster, because a small chunk fits the cache.
                words += ["--pipeline.model.eval-num-rays-per-chunk", "1024"]
            words += [*run.options, "nerfstudio-data", "--data", str(data.resolve())]
        else:
            # LPIPS is reported as for nerfacto, where its network can be downloaded.
            words += ["--pipeline.model.lpips", "True", *run.options]
            poses = "ground-truth" if run.true_poses else "estimated"
            words += ["aenerf-data", "--data", str(data.resolve()), "--poses", poses]
        log = self._folder / "logs" / f"{run.name}.log"
        run_command((*_WORKER, run.name, *words), log, self._folder, **self._variables)
        return ("ns-train", *(word.replace(f"{self._folder.resolve()}/", "") for word in words))


def _read(file: Path) -> dict[str, Any] | None:
    return json.loads(file.read_text("utf8")) if file.exists() else None


def _curve(run: Path) -> list[tuple[int, float]]:
    """Return steps and PSNR over the validation views during a training, from its TensorBoard log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(run))
    log.Reload()
    return [(event.step, event.value) for event in log.Scalars(_CURVE)] if _CURVE in log.Tags()["scalars"] else []
