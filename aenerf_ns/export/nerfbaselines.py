"""Write predictions and ``results.json`` as nerfbaselines 1.2 does, so that its evaluator and its tables read them."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

PREDICTIONS, RESULTS_FILE = "predictions", "results.json"
"""Names of the written folder and file, which nerfbaselines' own archives of a run have too."""

_RENDERED, _TRUE = "color", "gt-color"
# The evaluator's protocol that rounds display values to 8 bits and knows no background.
_PROTOCOL = "default"
_DATASET = "event-data"
_DIGITS = 5


def describe_run(method: str, scene: str, num_steps: int) -> dict[str, Any]:
    """Describe how predictions came about, as ``nb_info`` of nerfbaselines does.

    Args:
        method: name of the method.
        scene: name of the scene.
        num_steps: steps of the training.
    """
    return {
        "method": method,
        "num_iterations": num_steps,
        "dataset_metadata": {
            "id": _DATASET,
            "scene": scene,
            "evaluation_protocol": _PROTOCOL,
            "color_space": "srgb",
        },
        "evaluation_protocol": _PROTOCOL,
    }


def write_predictions(
    folder: Path, views: Iterable[tuple[str, Image.Image, Image.Image]], info: Mapping[str, Any]
) -> None:
    """Write renderings beside their truth.

    Args:
        folder: to create.
        views: name, rendering and truth of each view, of one size.
        info: see :func:`describe_run`.
    """
    for kind in (_RENDERED, _TRUE):
        (folder / kind).mkdir(parents=True)
    for name, rendering, truth in views:
        rendering.save(folder / _RENDERED / f"{name}.png")
        truth.save(folder / _TRUE / f"{name}.png")
    rendered = {
        "render_version": _version(),
        "render_datetime": _now(),
        "render_dataset_metadata": info["dataset_metadata"],
    }
    (folder / "info.json").write_text(json.dumps({**info, **rendered}, indent=2) + "\n", "utf8")


def write_results(
    path: Path, predictions: Path, info: Mapping[str, Any], metrics: Mapping[str, Sequence[float]]
) -> None:
    """Write the metrics of predictions.

    Args:
        path: JSON file to write.
        predictions: folder that :func:`write_predictions` wrote.
        info: see :func:`describe_run`.
        metrics: each metric's values, in the order of the views' names.
    """
    encoded = {
        name: base64.b64encode(np.asarray(values, "<f4").tobytes()).decode("ascii") for name, values in metrics.items()
    }
    results = {
        "render_version": _version(),
        "render_datetime": _now(),
        "render_dataset_metadata": info["dataset_metadata"],
        "nb_info": info,
        "evaluate_version": _version(),
        "evaluate_datetime": _now(),
        "metrics": {name: round(float(np.mean(values)), _DIGITS) for name, values in metrics.items()},
        "metrics_raw": encoded,
        "metrics_sha256": _hash_of_metrics(metrics),
        "predictions_sha256": _hash_of_files(predictions / _RENDERED),
        "ground_truth_sha256": _hash_of_files(predictions / _TRUE),
        "evaluation_protocol": info["evaluation_protocol"],
    }
    path.write_text(json.dumps(results, indent=2) + "\n", "utf8")


def _version() -> str:
    return f"aenerf-ns {version('aenerf-ns')}"


def _now() -> str:
    return datetime.now(timezone.utc).replace(tzinfo=None).isoformat(timespec="seconds")


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
