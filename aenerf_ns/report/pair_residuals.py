"""How the rendered changes of pairs of events compare with the measured ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.supervision.event_pairs import PairSupervision

_NUM_PAIRS = 20_000
# Upper ends of the classes of pairs by their number of events.
_LENGTHS = (1, 2, 4, 8, 16, 32, 64, np.inf)
# Tiles along the longer side of the sensor, and bins of the histogram along each axis.
_TILES, _BINS = 12, 60
# Share of pairs that may lie beyond either end of the histogram.
_MAX_BEYOND = 0.005
# Fewer pairs say little about a tile or a class.
_MIN_PAIRS = 10


@dataclass(frozen=True)
class PairResiduals:
    """Rendered changes of pairs of events beside the measured ones, in units of the mean contrast threshold.

    Attributes:
        num_pairs: pairs that were compared.
        edges: of the histogram's bins, alike along both axes.
        histogram: number of pairs by bin of the rendered change, then of the measured change.
        correlation: of rendered and measured changes, None where all of either are the same.
        mean_residual: mean absolute difference.
        by_length: ``mean_residual`` and ``num_pairs`` of classes of pairs by their number of ``events``,
            with those that a blind pixel missed.
        by_tile: rows of the mean absolute differences in tiles of the sensor, None where there are too few pairs.
    """

    num_pairs: int
    edges: list[float]
    histogram: list[list[int]]
    correlation: float | None
    mean_residual: float
    by_length: list[dict[str, Any]]
    by_tile: list[list[float | None]]


@torch.no_grad()
def measure_pair_residuals(run: TrainedRun) -> PairResiduals | None:
    """Render newly drawn pairs that end at events, the same in every call, and compare their changes.

    None for a run whose batches are not pairs, or whose pairs all end between events. The run is in evaluation mode,
    and its events are there.
    """
    drawn = None if run.sampler is None else run.sampler.residual_batch(2 * _NUM_PAIRS)
    if drawn is None:
        return None
    rays, batch = drawn
    at_events = ~batch.ends_between_events
    if not at_events.any():
        return None
    supervision = run.model.supervision
    assert isinstance(supervision, PairSupervision)
    num_pairs = len(batch)
    log_radiances = []
    chunk = max(run.model.config.eval_num_rays_per_chunk // 2, 1)
    for chosen in torch.arange(num_pairs, device=run.device).split(chunk):
        outputs = run.model(rays[torch.cat([chosen, chosen + num_pairs])])
        log_radiances.append(outputs["log_radiance"].unflatten(0, (2, -1)))
    # All pairs at once: the lag of slow pixels rests on the mean radiance of the others.
    outputs["log_radiance"] = torch.cat(log_radiances, 1).flatten(0, 1)
    changes = torch.stack(supervision.changes(outputs, batch)) / supervision.loss_unit(outputs)
    rendered, measured = changes[:, at_events].double().cpu().numpy()
    batch = batch[at_events]
    length = (batch.num_positive + batch.num_negative).floor().cpu().numpy()
    residual = np.abs(rendered - measured)
    edges, histogram = _histogram(measured, rendered)
    varies = min(np.ptp(measured), np.ptp(rendered)) > 0
    camera = run.scene.event_camera
    return PairResiduals(
        num_pairs=len(residual),
        edges=edges,
        histogram=histogram,
        correlation=float(np.corrcoef(measured, rendered)[0, 1]) if varies else None,
        mean_residual=float(residual.mean()),
        by_length=average_by_length(length, residual),
        by_tile=average_by_tile(batch.pixel.cpu().numpy(), residual, camera.width, camera.height),
    )


def _histogram(measured: NDArray[np.float64], rendered: NDArray[np.float64]) -> tuple[list[float], list[list[int]]]:
    end = float(np.abs(np.quantile([measured, rendered], [_MAX_BEYOND, 1 - _MAX_BEYOND])).max())
    rows, columns = np.clip([rendered, measured], -end, end)
    counts, edges, _ = np.histogram2d(rows, columns, bins=_BINS, range=[(-end, end)] * 2)
    return edges.tolist(), counts.astype(int).tolist()


def average_by_length(length: NDArray[np.floating], residual: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Average the (N,) residuals of pairs in classes by the (N,) numbers of their events."""
    classes: list[dict[str, Any]] = []
    low: float = 1
    for high in _LENGTHS:
        chosen = residual[(length >= low) & (length <= high)]
        if len(chosen) >= _MIN_PAIRS:
            name = str(low) if low == high else f"{low} to {high}" if high < np.inf else f"{low} or more"
            classes.append({"events": name, "num_pairs": len(chosen), "mean_residual": float(chosen.mean())})
        low = high + 1
    return classes


def average_by_tile(
    pixel: NDArray[np.int64], residual: NDArray[np.float64], width: int, height: int
) -> list[list[float | None]]:
    """Average the (N,) residuals of pairs in tiles of the sensor by their (N,) pixels, counted row by row."""
    side = max(width, height) / _TILES
    shape = (int(np.ceil(height / side)), int(np.ceil(width / side)))
    rows, columns = np.divmod(pixel, width)
    tile = (rows // side).astype(int) * shape[1] + (columns // side).astype(int)
    counts = np.bincount(tile, minlength=shape[0] * shape[1])
    sums = np.bincount(tile, residual, minlength=shape[0] * shape[1])
    means = [float(total / count) if count >= _MIN_PAIRS else None for total, count in zip(sums, counts, strict=True)]
    return [means[row * shape[1] : (row + 1) * shape[1]] for row in range(shape[0])]
