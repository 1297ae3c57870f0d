"""The renderings of a run's test views, beside their truth and with their metrics, for nerfbaselines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig
from PIL import Image

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import IMAGE_METRICS, picture_names, to_image
from aenerf_ns.export.nerfbaselines import PREDICTIONS, RESULTS_FILE, describe_run, write_predictions, write_results
from aenerf_ns.progress import track


def export_predictions(run: TrainedRun, folder: Path, config: TrainerConfig, views: list[dict[str, Any]]) -> None:
    """Write the test views as ``predictions``, and their metrics as ``results.json``, in the layout of nerfbaselines.

    The cameras are as the evaluation places them, not refined.

    Args:
        run: as it is opened to be tested.
        folder: to create.
        config: of the run.
        views: one or more; see :func:`~aenerf_ns.evaluation.view_metrics.describe_views`.
    """
    assert run.views is not None
    names = picture_names(run.views.image_filenames)
    info = describe_run(config.method_name, run.data.name, config.max_num_iterations)
    write_predictions(folder / PREDICTIONS, _render_views(run, names), info)
    # The evaluator reads the views in the order of their names.
    placed = [view["placed"] for _, view in sorted(zip(names, views, strict=True), key=lambda pair: pair[0])]
    metrics = {name: [view[name] for view in placed] for name in IMAGE_METRICS if name in placed[0]}
    write_results(folder / RESULTS_FILE, folder / PREDICTIONS, info, metrics)


@torch.no_grad()
def _render_views(run: TrainedRun, names: list[str]) -> Iterator[tuple[str, Image.Image, Image.Image]]:
    """Yield name, rendering and truth of each test view."""
    model, views = run.model.eval(), run.views
    assert views is not None
    for index, name in enumerate(track(names, "Rendering predictions")):
        outputs = model.get_outputs_for_camera(views.cameras[index : index + 1].to(run.device))
        truth = model.reference_display(views.get_image_float32(index).to(run.device))
        yield name, to_image(outputs["rgb"]), to_image(truth)
