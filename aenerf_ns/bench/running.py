"""Making the runs of a benchmark: simulate, train, evaluate, and keep the figures.

Everything lies in one folder, which can be worked on again and by several processes at once, each of which leaves alone
what another is making:

    datasets/DATASET/       what was simulated
    outputs/RUN/            what was trained, as ns-train leaves it
    logs/                   what the commands printed
    runs/RUN.json           the figures of a run; a run that has them is not made again
    runs/RUN/               pictures of the test views, and the corrected trajectory
"""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import subprocess
import sys
import time
from decimal import Decimal
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from aenerf_ns.bench.environment import environment
from aenerf_ns.bench.plan import CEILING, OURS, Dataset, Run, scene_name
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import read_tum_trajectory

# Parts of a training. The framework looks at the views after each but the last, whose final step it counts as one less.
_CURVE_PARTS = 5
_CURVE = "Eval Images Metrics Dict (all images)/psnr"
_NERFACTO = (sys.executable, "-m", "aenerf_ns.bench.nerfacto")


class Runner:
    """Makes runs in a folder.

    Args:
        folder: of the benchmark.
        device: "cuda" or "cpu".
    """

    def __init__(self, folder: Path, device: str) -> None:
        self._folder = folder
        self._device = device
        self._failed: dict[str, DataError] = {}
        for name in ("datasets", "outputs", "logs", "runs"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def figures(self, run: Run) -> dict[str, Any] | None:
        """The figures of a run, None where it has not been made."""
        return _read(self._figures_file(run))

    def make(self, run: Run) -> dict[str, Any] | None:
        """Makes a run, unless that has been done.

        Returns:
            Its figures; None where another process is making it.

        Raises:
            DataError: a command failed.
        """
        try:
            with FileLock(self._folder / "runs" / f".{run.name}.lock", timeout=0):
                return self.figures(run) or self._make(run)
        except Timeout:
            return None

    def _make(self, run: Run) -> dict[str, Any]:
        # What the run is made with, not what is there by its end.
        origin = environment()
        data = self._dataset(run.dataset)
        # What was left by a training that was killed.
        shutil.rmtree(self._folder / "outputs" / run.name, ignore_errors=True)
        begin = time.perf_counter()
        training = self._train(run, data)
        seconds = time.perf_counter() - begin
        (config,) = (self._folder / "outputs" / run.name).rglob("config.yml")
        results = self._evaluate(run, config)
        figures = {
            "table": run.table,
            "row": run.row,
            "scene": scene_name(run.dataset.scene),
            "kind": "object" if "scene_box" in json.loads((data / "transforms.json").read_text("utf8")) else "large",
            "speed": run.dataset.speed,
            "poses": "true" if run.true_poses else run.dataset.poses,
            "method": run.method,
            "steps": run.steps,
            "seed": run.seed,
            "device": self._device,
            "simulate": shlex.join(("aenerf", "simulate", *run.dataset.command)),
            "train": shlex.join(training),
            "train_seconds": round(seconds),
            "poses_report": _read(data / "poses_report.json"),
            "results": results,
            "curve": _curve(config.parent),
            **origin,
        }
        file = self._figures_file(run)
        partial = file.with_suffix(f".{os.getpid()}")
        partial.write_text(json.dumps(figures, indent=2) + "\n", "utf8")
        partial.rename(file)
        return figures

    def _figures_file(self, run: Run) -> Path:
        return self._folder / "runs" / f"{run.name}.json"

    def _dataset(self, dataset: Dataset) -> Path:
        if dataset.name in self._failed:
            # Every one of its runs would simulate anew, and fail at the same place.
            raise self._failed[dataset.name]
        folder = self._folder / "datasets" / dataset.name
        # Where another process is making the same, its work is waited for.
        with FileLock(folder.with_name(f".{dataset.name}.lock")):
            if not folder.exists():
                # A built-in scene's name has no suffix; a file's path is relative to where the benchmark was started.
                scene = str(Path(dataset.scene).resolve()) if Path(dataset.scene).suffix else dataset.scene
                options = ("--scene", scene, *dataset.command[2:])
                output = str(folder.resolve())
                try:
                    self._call(dataset.name, _script("aenerf"), "simulate", "--output", output, *options)
                except DataError as error:
                    self._failed[dataset.name] = error
                    raise
        return folder

    def _train(self, run: Run, data: Path) -> tuple[str, ...]:
        """Returns the command, without the folders of this machine."""
        common = (
            run.method, "--machine.device-type", self._device, "--machine.seed", str(run.seed), "--vis", "tensorboard",
            "--experiment-name", run.name, "--output-dir", "outputs", "--max-num-iterations", str(run.steps),
            "--steps-per-eval-all-images", str(max(run.steps // _CURVE_PARTS, 1)),
        )  # fmt: skip
        if run.row == CEILING:
            # Of the framework's implementations, the one that needs no CUDA extension.
            command = [
                *_NERFACTO, "ns-train", *common, "--pipeline.model.implementation", "torch",
                "--pipeline.model.camera-optimizer.mode", "off", "--pipeline.model.use-appearance-embedding", "False",
            ]  # fmt: skip
            if self._device == "cpu":
                # The same pictures, sooner: what a piece needs stays small.
                command += ["--pipeline.model.eval-num-rays-per-chunk", "1024"]
            command += [*run.options, "nerfstudio-data", "--data", str(_with_true_poses(data).resolve())]
        else:
            # LPIPS is reported where its network can be had, as nerfacto's is.
            command = [_script("ns-train"), *common, "--pipeline.model.lpips", "True", *run.options]
            poses = "ground-truth" if run.true_poses else "estimated"
            command += ["aenerf-data", "--data", str(data.resolve()), "--poses", poses]
        self._call(run.name, *command)
        words = (word.replace(f"{self._folder.resolve()}/", "") for word in command[1:])
        return (Path(command[0]).name, *words)

    def _evaluate(self, run: Run, config: Path) -> dict[str, Any]:
        relative = str(config.relative_to(self._folder))
        folder = Path("runs") / run.name
        output = folder / "evaluation.json"
        command = (*_NERFACTO, "ns-eval") if run.row == CEILING else (_script("ns-eval"),)
        pictures = ("--render-output-path", str(folder / "pictures"))
        self._call(run.name, *command, "--load-config", relative, "--output-path", str(output), *pictures)
        results = json.loads((self._folder / output).read_text("utf8"))["results"]
        (self._folder / output).unlink()
        if run.row == CEILING:
            # JSON has no NaN.
            return {name: None if math.isnan(value) else value for name, value in results.items()}
        if run.row == OURS:
            corrected = str(folder / "corrected.txt")
            self._call(
                run.name, _script("aenerf"), "export-trajectory", "--load-config", relative, "--output", corrected
            )
        return results

    def _call(self, log: str, *command: str) -> None:
        """Runs a command in the benchmark's folder.

        Raises:
            DataError: it failed.
        """
        file = self._folder / "logs" / f"{log}.log"
        # ns-eval has no option for this.
        hidden = {"CUDA_VISIBLE_DEVICES": ""} if self._device == "cpu" else {}
        with file.open("a", encoding="utf8") as output:
            output.write(f"$ {shlex.join(command)}\n")
            output.flush()
            with subprocess.Popen(
                command, cwd=self._folder, env={**os.environ, **hidden}, stdout=output, stderr=subprocess.STDOUT
            ) as process:
                try:
                    status = process.wait()
                except BaseException:
                    # Left alone, it would go on beside what the next call starts in its place.
                    process.terminate()
                    raise
        if status:
            raise DataError(file, f"a command ended with status {status}", "see the end of this file")


def _read(file: Path) -> dict[str, Any] | None:
    return json.loads(file.read_text("utf8")) if file.exists() else None


def _script(name: str) -> str:
    """A console script of this environment."""
    return str(Path(sys.executable).parent / name)


def _with_true_poses(data: Path) -> Path:
    """A transforms.json whose train images have their true poses, beside the dataset's own, for image methods."""
    file = data / "transforms_ground_truth.json"
    truth = read_tum_trajectory(data / "trajectory_ground_truth.txt")
    meta = json.loads((data / "transforms.json").read_text("utf8"), parse_float=Decimal)
    for frame in meta["frames"]:
        if frame["file_path"] in meta["train_filenames"]:
            pose = homogeneous(truth.interpolate(int(frame["timestamp"] * 10**9))) @ OPENCV_TO_OPENGL
            frame["transform_matrix"] = pose.tolist()
    partial = file.with_suffix(f".{os.getpid()}")
    partial.write_text(json.dumps(meta, default=float), "utf8")
    partial.rename(file)
    return file


def _curve(run: Path) -> list[tuple[int, float]]:
    """PSNR over the validation views, which is what the framework looks at while it trains: steps and values, from a
    training's TensorBoard log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(run))
    log.Reload()
    return [(event.step, event.value) for event in log.Scalars(_CURVE)] if _CURVE in log.Tags()["scalars"] else []
