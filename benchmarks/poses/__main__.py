"""Measure how well poses are corrected, beside true poses at the same steps, with several seeds.

    python -m benchmarks.scenes.build --output scenes
    python -m benchmarks.poses --scenes-folder scenes --work work --output benchmarks/results/poses_cpu2.json
    python -m benchmarks.poses --split choose --variants density="--pipeline.model.average-init-density 3" ...

Each recording is trained with its wrong poses and, as a control, with its true poses. Every variant of the settings is
trained on the same recordings with the same seeds. A finished training is found again in the folder ``--work``, so a
measurement that was stopped goes on. See ``scenes.py`` for the recordings, and ``worker.py`` for the measures.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from aenerf_ns.progress import progress_bar
from benchmarks.poses.scenes import SCENES, Split, scene_argument
from benchmarks.runs import make_dataset, run_benchmark, run_command, write_result

_WORKER = Path(__file__).with_name("worker.py")
_CASES = {
    "noise, corrected": ("estimated", ()),
    "noise, not corrected": ("estimated", ("--pipeline.model.camera-optimizer.mode", "off")),
    "true poses, corrected": ("ground-truth", ()),
    "true poses": ("ground-truth", ("--pipeline.model.camera-optimizer.mode", "off")),
}
_DEFAULT = "default"


@dataclass
class Poses:
    """Measure the correction of poses."""

    output: Path
    """JSON file to write after each training."""
    work: Path
    """Folder for datasets, logs and the results of single trainings."""
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
    refine: bool = True
    """Also evaluate with test poses that are refined photometrically."""
    jobs: int = 1
    """Trainings at a time, each with one thread."""

    def main(self) -> None:
        """Simulate and train whatever is missing, and write the table."""
        names = self.scenes or tuple(name for name, scene in SCENES.items() if self.split in ("all", scene.split))
        unknown = (set(names) - set(SCENES)) | (set(self.cases) - set(_CASES))
        if unknown:
            sys.exit(
                f"unknown: {', '.join(sorted(unknown))}; scenes are {', '.join(SCENES)}; cases {', '.join(_CASES)}"
            )
        for folder in ("datasets", "runs", "logs"):
            (self.work / folder).mkdir(parents=True, exist_ok=True)
        variants = {_DEFAULT: "", **self.variants}
        todo = [
            (name, case, variant, seed)
            for seed in self.seeds
            for name in names
            for case in self.cases
            for variant in variants
        ]
        runs: list[dict[str, Any]] = []
        with progress_bar() as progress, ThreadPoolExecutor(self.jobs) as pool:
            bar = progress.add_task("Poses", total=len(names) + len(todo))
            for name in names:
                self._dataset(name)
                progress.advance(bar)

            def run(settings: tuple[str, str, str, int]) -> dict[str, Any]:
                name, case, variant, seed = settings
                found = self._train(name, case, variants[variant], seed)
                return {"scene": name, "case": case, "variant": variant, "seed": seed, **found}

            for finished in pool.map(run, todo):
                runs.append(finished)
                progress.advance(bar)
                write_result(
                    self.output,
                    {
                        "method": self.method,
                        "steps": self.steps,
                        "variants": variants,
                        "scenes": {n: {"about": SCENES[n].about, "simulate": SCENES[n].options} for n in names},
                        "table": table(runs),
                        "runs": runs,
                    },
                    show=False,
                )

    def _dataset(self, name: str) -> Path:
        """Return the dataset of a scene, which is simulated if it is missing."""
        scene, file_name = SCENES[name], name.replace(" ", "_")
        argument = scene_argument(scene.scene, self.scenes_folder, self.work / "scenes")
        folder, log = self.work / "datasets" / file_name, self.work / "logs" / f"{file_name}.log"
        return make_dataset(folder, log, "simulate", ("--scene", argument, *scene.options))

    def _train(self, name: str, case: str, options: str, seed: int) -> dict[str, Any]:
        """Return the results of a training, from the file of an earlier one if there is one."""
        poses, of_case = _CASES[case]
        evaluation = "refined" if self.refine else "placed"
        arguments = (
            self.method, "--machine.device-type", "cpu", "--machine.seed", str(seed), "--vis", "tensorboard",
            "--max-num-iterations", str(self.steps), *of_case, *shlex.split(options),
        )  # fmt: skip
        # Without the folder of this machine.
        digest = hashlib.sha256("\0".join((name, poses, evaluation, *arguments)).encode()).hexdigest()[:12]
        result = self.work / "runs" / f"{digest}.json"
        if not result.exists():
            command = [
                sys.executable, str(_WORKER), str(result.resolve()), evaluation, *arguments,
                "--output-dir", str((self.work / "outputs" / digest).resolve()),
                "aenerf-data", "--data", str(self._dataset(name).resolve()), "--poses", poses,
            ]  # fmt: skip
            log = self.work / "logs" / f"{digest}.log"
            run_command(command, log, OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
        return json.loads(result.read_text("utf8"))


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
            values = {seed: run[poses]["psnr"] for seed, run in own.items() if poses in run}
            if not values:
                continue
            row[f"psnr_{poses}"] = _summary(list(values.values()))
            for name, other in (
                ("less_than_true_poses", (scene, "true poses", variant)),
                ("more_than_default", (scene, case, _DEFAULT)),
            ):
                differences = [
                    values[seed] - of[(*other, seed)][poses]["psnr"] for seed in values if (*other, seed) in of
                ]
                if differences and other != (scene, case, variant):
                    sign = -1 if name == "less_than_true_poses" else 1
                    row[f"psnr_{poses}_{name}"] = _summary([sign * value for value in differences])
        ends = [run["poses"]["end"] for run in own.values()]
        row["degrees"] = _summary([end["degrees"] for end in ends])
        row["translation"] = _summary([end["translation"] for end in ends])
        row["pixels"] = {lag: _summary([end["pixels"][lag] for end in ends]) for lag in ends[0]["pixels"]}
        row["plateau_left_at"] = [run["plateau_left_at"] for run in own.values()]
        rows.append(row)
    return rows


def _summary(values: list[float]) -> dict[str, float]:
    return {"mean": math.fsum(values) / len(values), "spread": max(values) - min(values)}


if __name__ == "__main__":
    run_benchmark(Poses)
