"""Train variants of methods on datasets, side by side, and follow their losses and their proposal networks.

    python -m benchmarks.variants --data room data/room --variants default aenerf-small \
        decayed "aenerf-small --optimizers.proposals.optimizer.weight-decay 1e-6" --steps 400 --output variants.json

All runs are made in one process, because each start takes long. A variant is the name of a method and options of
ns-train. PSNR is of the test views, as placed. Train without correction on true poses only.
"""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from torch import Tensor

from aenerf_ns.evaluation.view_metrics import average_metrics, measure_reference_views
from aenerf_ns.training.trainer import AENeRFTrainer
from benchmarks.runs import new_trainer, run_benchmark, write_result


@dataclass
class Variants:
    """Train variants of methods."""

    output: Path
    """JSON file to write after each training."""
    data: dict[str, Path]
    """Folders of datasets by name."""
    variants: dict[str, str]
    """Method and options of ns-train by the name of a variant."""
    steps: int = 400
    """Steps of each training."""
    seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of the trainings."""
    points: int = 6
    """Steps at which a run is looked at."""
    curve: bool = False
    """Measure PSNR at each of them, too."""
    pictures: Path | None = None
    """Folder for the pictures of the test views."""

    def main(self) -> None:
        """Make all runs, and write them."""
        runs: list[dict[str, Any]] = []
        for seed in self.seeds:
            for dataset, folder in self.data.items():
                for variant, words in self.variants.items():
                    about = {"dataset": dataset, "variant": variant, "seed": seed}
                    runs.append(about | self._run(folder, shlex.split(words), seed))
                    write_result(self.output, {"steps": self.steps, "variants": self.variants, "runs": runs}, False)
                    print({name: value for name, value in runs[-1].items() if name != "followed"}, flush=True)

    def _run(self, folder: Path, words: list[str], seed: int) -> dict[str, Any]:
        followed: list[dict[str, Any]] = []
        with TemporaryDirectory() as output:
            trainer = new_trainer(words, folder, Path(output), self.steps, seed)
            self._follow(trainer, followed)
            begin = time.process_time()
            trainer.train()
            seconds = time.process_time() - begin
        return {**_metrics(trainer, self.pictures), "cpu_seconds": round(seconds), "followed": followed}

    def _follow(self, trainer: AENeRFTrainer, followed: list[dict[str, Any]]) -> None:
        model, interval = trainer.pipeline.model, max(self.steps // self.points, 1)
        losses_of, latest = model.get_loss_dict, {}

        def get_loss_dict(outputs: dict[str, Any], *arguments: Any) -> dict[str, Tensor]:
            losses = losses_of(outputs, *arguments)
            weights = outputs["weights_list"][-2][..., 0].detach()
            shares = weights / weights.sum(-1, keepdim=True)
            latest.update({name: float(loss.detach()) for name, loss in losses.items()})
            # The number of intervals over which a histogram that is even there would spread as widely.
            latest["proposal_intervals"] = float((1 / shares.square().sum(-1)).nanmean())
            return losses

        def look(step: int) -> None:
            if (step + 1) % interval and step > 0:
                return
            named = model.proposal_networks.named_parameters()
            weights = torch.cat([p.detach().flatten() for name, p in named if name.endswith("weight")])
            psnr = _metrics(trainer, None) if self.curve and 0 < step < self.steps - 1 else {}
            followed.append({"step": step + 1, "proposal_rms": float(weights.square().mean().sqrt()), **latest, **psnr})

        model.get_loss_dict = get_loss_dict
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        trainer.callbacks.append(TrainingCallback(after, look, update_every_num_iters=1))


def _metrics(trainer: AENeRFTrainer, pictures: Path | None) -> dict[str, Any]:
    """Return PSNR and SSIM of the test views."""
    pipeline = trainer.pipeline
    pipeline.color_fit.fit()
    views = pipeline.datamanager.reference_views("test")
    run = replace(pipeline.trained_run(), views=views)
    metrics = average_metrics(measure_reference_views(run, pictures), with_deviations=False)
    return {name: metrics[name] for name in ("psnr", "ssim")}


if __name__ == "__main__":
    run_benchmark(Variants)
