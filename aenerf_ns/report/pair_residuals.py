"""How the rendered changes of pairs of events compare with the measured ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.supervision.event_pairs import PairSampler, PairSupervision

_NUM_PAIRS = 20_000
# Upper ends of the classes of pairs by their number of events.
_LENGTHS = (1, 2, 4, 8, 16, 32, 64, 255)
# Tiles along the longer side of the sensor, and bins of the histogram along each axis.
_TILES, _BINS = 12, 60
# Share of pairs that may lie beyond either end of the histogram.
_BEYOND = 0.005
# Fewer pairs say little of a tile or a class.
_LEAST = 10


@torch.no_grad()
def pair_residuals(run: TrainedRun) -> dict[str, Any] | None:
    """Render newly drawn pairs that end at events, the same in every call, and compare their changes.

    Args:
        run: in evaluation mode. Its events are there.

    Returns:
        In units of the mean contrast threshold: a ``histogram`` of rendered against measured changes with its
        ``edges``, their ``correlation``, the mean absolute residual ``by_length`` (events of a pair) and ``by_tile``,
        None where there are too few pairs. None for a run whose batches are no pairs.
    """
    sampler, supervision = run.sampler, run.model.supervision
    if not isinstance(sampler, PairSampler) or not isinstance(supervision, PairSupervision):
        return None
    devices = [run.device] if run.device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(0)
        rays, batch = sampler.sample(2 * _NUM_PAIRS, training=False)
    num_pairs = len(batch["channel"])
    pieces = []
    chunk = run.model.config.eval_num_rays_per_chunk // 2
    for begin in range(0, num_pairs, chunk):
        chosen = torch.arange(begin, min(begin + chunk, num_pairs), device=run.device)
        outputs = run.model(rays[torch.cat([chosen, chosen + num_pairs])])
        part = {name: values[chosen] for name, values in batch.items()}
        unit = supervision.unit(outputs)
        pieces.append(torch.stack([one / unit for one in supervision.changes(outputs, part)]))
    rendered, measured = torch.cat(pieces, -1).double().cpu().numpy()
    at_events = ~batch["ends_between_events"].cpu().numpy()
    length = (batch["num_positive"] + batch["num_negative"]).cpu().numpy()[at_events]
    pixel = batch["pixel"].cpu().numpy()[at_events]
    rendered, measured = rendered[at_events], measured[at_events]
    residual = np.abs(rendered - measured)
    return {
        "num_pairs": len(residual),
        **_histogram(measured, rendered),
        "correlation": float(np.corrcoef(measured, rendered)[0, 1]),
        "mean_residual": float(residual.mean()),
        "by_length": _by_length(length, residual),
        "by_tile": _by_tile(pixel, residual, run.scene.event_camera),
    }


def _histogram(measured: np.ndarray, rendered: np.ndarray) -> dict[str, Any]:
    both = np.concatenate([measured, rendered])
    end = float(np.abs(np.quantile(both, [_BEYOND, 1 - _BEYOND])).max())
    edges = np.linspace(-end, end, _BINS + 1)
    ends = [(-end, end), (-end, end)]
    counts, _, _ = np.histogram2d(np.clip(rendered, -end, end), np.clip(measured, -end, end), bins=_BINS, range=ends)
    return {"edges": edges.tolist(), "histogram": counts.astype(int).tolist()}


def _by_length(length: np.ndarray, residual: np.ndarray) -> list[dict[str, Any]]:
    classes, low = [], 1
    for high in _LENGTHS:
        chosen = residual[(length >= low) & (length <= high)]
        if len(chosen) >= _LEAST:
            name = str(low) if low == high else f"{low} to {high}"
            classes.append({"events": name, "num_pairs": len(chosen), "mean_residual": float(chosen.mean())})
        low = high + 1
    return classes


def _by_tile(pixel: np.ndarray, residual: np.ndarray, camera: Any) -> list[list[float | None]]:
    side = max(camera.width, camera.height) / _TILES
    shape = (int(np.ceil(camera.height / side)), int(np.ceil(camera.width / side)))
    rows, columns = np.divmod(pixel, camera.width)
    tile = (rows // side).astype(int) * shape[1] + (columns // side).astype(int)
    counts = np.bincount(tile, minlength=shape[0] * shape[1])
    sums = np.bincount(tile, residual, minlength=shape[0] * shape[1])
    means = [float(total / count) if count >= _LEAST else None for total, count in zip(sums, counts, strict=True)]
    return [means[row * shape[1] : (row + 1) * shape[1]] for row in range(shape[0])]
