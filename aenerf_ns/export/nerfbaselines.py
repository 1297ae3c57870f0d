"""Write predictions and ``results.json`` as nerfbaselines 1.2 does, so that its evaluator and its tables read them."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.engine.trainer import TrainerConfig
from PIL import Image

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.evaluation.view_metrics import IMAGE_METRICS, picture_names, to_image
from aenerf_ns.progress import track

# Names of the written folder and file, which nerfbaselines' own archives of a run have too.
_PREDICTIONS, _RESULTS_FILE = "predictions", "results.json"
_RENDERED, _TRUE = "color", "gt-color"
# The evaluator's protocol that rounds display values to 8 bits and knows no background.
_PROTOCOL = "default"
_DATASET = "event-data"
_DIGITS = 5


def export_predictions(run: TrainedRun, folder: Path, config: TrainerConfig, views: list[dict[str, Any]]) -> None:
    """Write the test views as ``predictions``, and their metrics as ``results.json``, in the layout of nerfbaselines.

    The cameras are as the evaluation places them, not refined.

    Args:
        run: as it is opened to be tested.
        folder: the folder to create.
        config: of the run.
        views: one or more; see :func:`~aenerf_ns.evaluation.view_metrics.describe_views`.
    """
    assert run.views is not None
    names = picture_names(run.views.image_filenames)
    info = describe_run(config.method_name, run.data.name, config.max_num_iterations)
    write_predictions(folder / _PREDICTIONS, _render_views(run, names), info)
    placed = {name: view["placed"] for name, view in zip(names, views, strict=True)}
    write_results(folder / _RESULTS_FILE, folder / _PREDICTIONS, info, placed)


def _render_views(run: TrainedRun, names: list[str]) -> Iterator[tuple[str, Image.Image, Image.Image]]:
    """Yield name, rendering and truth of each test view."""
    model, views = run.model.eval(), run.views
    assert views is not None
    for index, name in enumerate(track(names, "Rendering predictions")):
        outputs = model.get_outputs_for_camera(views.cameras[index : index + 1].to(run.device))
        truth = model.reference_display(views.get_image_float32(index).to(run.device))
        yield name, to_image(outputs["rgb"]), to_image(truth)


def describe_run(method: str, scene: str, num_steps: int) -> dict[str, Any]:
    """Describe how predictions came about, as ``nb_info`` of nerfbaselines does."""
    return {
        "method": method,
        "num_iterations": num_steps,
        "dataset_metadata": {"id": _DATASET, "scene": scene, "evaluation_protocol": _PROTOCOL, "color_space": "srgb"},
        "evaluation_protocol": _PROTOCOL,
    }


def write_predictions(
    folder: Path, views: Iterable[tuple[str, Image.Image, Image.Image]], info: Mapping[str, Any]
) -> None:
    """Write the rendering and the truth of each named view to a new folder, with :func:`describe_run`'s ``info``."""
    for kind in (_RENDERED, _TRUE):
        (folder / kind).mkdir(parents=True)
    for name, rendering, truth in views:
        rendering.save(folder / _RENDERED / f"{name}.png")
        truth.save(folder / _TRUE / f"{name}.png")
    rendered = {**_stamp("render"), "render_dataset_metadata": info["dataset_metadata"]}
    (folder / "info.json").write_text(json.dumps({**info, **rendered}, indent=2) + "\n", "utf8")


def write_results(
    path: Path, predictions: Path, info: Mapping[str, Any], views: Mapping[str, Mapping[str, float]]
) -> None:
    """Write the metrics of predictions in a folder as JSON, given those of each view by its name."""
    # nerfbaselines reads the views in the order of their files.
    ordered = [views[name] for name in sorted(views, key="{}.png".format)]
    metrics = {name: [view[name] for view in ordered] for name in IMAGE_METRICS if name in ordered[0]}
    encoded = {
        name: base64.b64encode(np.asarray(values, "<f4").tobytes()).decode("ascii") for name, values in metrics.items()
    }
    results = {
        **_stamp("render"),
        "render_dataset_metadata": info["dataset_metadata"],
        "nb_info": info,
        **_stamp("evaluate"),
        "metrics": {name: round(float(np.mean(values)), _DIGITS) for name, values in metrics.items()},
        "metrics_raw": encoded,
        "metrics_sha256": _hash_of_metrics(metrics),
        "predictions_sha256": _hash_of_files(predictions / _RENDERED),
        "ground_truth_sha256": _hash_of_files(predictions / _TRUE),
        "evaluation_protocol": info["evaluation_protocol"],
    }
    path.write_text(json.dumps(results, indent=2) + "\n", "utf8")


def _stamp(stage: str) -> dict[str, str]:
    """Return the program and the time of a stage: "render" or "evaluate"."""
    now = datetime.now(timezone.utc).replace(tzinfo=None).isoformat(timespec="seconds")
    return {f"{stage}_version": f"aenerf-ns {version('aenerf-ns')}", f"{stage}_datetime": now}


def _hash_of_files(folder: Path) -> str:
    found = hashlib.sha256()
    for file in sorted(folder.iterdir()):
        found.update(file.read_bytes())
    return found.hexdigest()


def _hash_of_metrics(metrics: Mapping[str, Sequence[float]]) -> str:
    found = hashlib.sha256()
    for name in sorted(metrics):
        values = np.sort(np.asarray(metrics[name], "<f4")).tobytes()
        found.update(name.lower().encode() + base64.b64encode(values) + b"\n")
    return found.hexdigest()
