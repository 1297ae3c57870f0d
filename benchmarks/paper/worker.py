"""Train by ns-train, evaluate by ns-eval and export the poses, in one process, because each start takes long.

    python benchmarks/paper/worker.py RUN METHOD OPTIONS

Runs in the benchmark's folder. The options put the trained run into ``outputs/RUN``. Writes
``runs/RUN/evaluation.json``, pictures of the test views beside it, and, but for nerfacto, ``corrected.txt``. Then the
results have ``psnr_network`` too: the PSNR of the views as placed under the paper's color correction (15).

Nerfstudio's nerfacto is run where it would fail, and with metrics that can be compared. Three things differ from
Nerfstudio's own commands:

- nerfacto always builds LPIPS, which fails without a connection. The metric is then NaN.
- nerfacto's checkpoints hold NumPy numbers, which recent versions of torch refuse to load unless the file is trusted.
- nerfacto's SSIM takes the range of each picture as the data range. Here the data range is 1, as in all other rows.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn


class _Absent(nn.Module):
    """A metric that cannot be computed."""

    def forward(self, *_: Tensor) -> Tensor:
        return torch.tensor(torch.nan)


def prepare() -> None:
    """Change LPIPS, SSIM and the loading of checkpoints, in this process."""
    import torchmetrics.functional as functional
    import torchmetrics.image.lpip as lpip

    build = lpip.LearnedPerceptualImagePatchSimilarity

    def build_or_leave_out(*arguments: Any, **options: Any) -> nn.Module:
        try:
            return build(*arguments, **options)
        except Exception:
            # torch.hub passes on all exceptions of the connection.
            return _Absent()

    lpip.LearnedPerceptualImagePatchSimilarity = build_or_leave_out  # type: ignore[misc,assignment]
    functional.structural_similarity_index_measure = partial(
        functional.structural_similarity_index_measure, data_range=1.0
    )
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"


def keep_renderings() -> None:
    """Let views that are rendered twice keep what was rendered at first, because rendering takes most of the time."""
    from nerfstudio.cameras.cameras import Cameras

    from aenerf_ns.method.model import AENeRFModel

    render, kept = AENeRFModel.get_outputs_for_camera, {}

    def render_once(model: AENeRFModel, camera: Cameras) -> dict[str, Tensor]:
        if not camera.metadata:
            # Its pose was refined under one color correction.
            return render(model, camera)
        pose = camera.camera_to_worlds.cpu().numpy().tobytes()
        if pose not in kept:
            kept[pose] = render(model, camera)
        return {**kept[pose], "rgb": model.display(kept[pose]["log_radiance"])}

    AENeRFModel.get_outputs_for_camera = render_once  # type: ignore[method-assign,assignment]


def main() -> None:
    """Train, evaluate and export."""
    begin = time.perf_counter()
    name, method, *options = sys.argv[1:]
    if method == "nerfacto":
        prepare()
    # Imported here, because nerfacto imports what was changed.
    from nerfstudio.scripts import train
    from nerfstudio.scripts.eval import ComputePSNR

    from aenerf_ns.cli.export import ExportTrajectory
    from aenerf_ns.cli.trained_run import open_run
    from aenerf_ns.evaluation.color_fit import replace_color_correction
    from aenerf_ns.evaluation.view_metrics import average_metrics, measure_reference_views

    sys.argv = ["ns-train", method, *options]
    train.entrypoint()
    seconds = time.perf_counter() - begin
    # The evaluation then has the memory that the training had.
    gc.collect()
    (config,) = (Path("outputs") / name).rglob("config.yml")
    folder = Path("runs") / name
    file = folder / "evaluation.json"
    if method != "nerfacto":
        keep_renderings()
    ComputePSNR(config, file, folder / "pictures").main()
    evaluation = {**json.loads(file.read_text("utf8")), "train_seconds": seconds}
    if method != "nerfacto":
        ExportTrajectory(config, folder / "corrected.txt").main()
        _, run, _ = open_run(config)
        replace_color_correction(run, "network")
        evaluation["results"]["psnr_network"] = average_metrics(measure_reference_views(run), False)["psnr"]
    file.write_text(json.dumps(evaluation), "utf8")


if __name__ == "__main__":
    main()
