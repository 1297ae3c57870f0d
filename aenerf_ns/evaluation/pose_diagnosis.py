"""Self-diagnosis of pose correction: what the end of a training tells of it without true poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.method.pose_correction import PoseCorrection
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.base import Sampler

if TYPE_CHECKING:
    from aenerf_ns.checking.hypotheses import Comparison

LAST_PART = 0.1
"""The part of a run, at its end, over which the movement of the corrected poses is taken."""

# Stretches of equal time. The loss of a stretch is taken on so many pairs at most, and not on fewer than the least.
_NUM_STRETCHES = 10
_PAIRS_PER_STRETCH, _LEAST_PAIRS = 512, 64
# Fast motion puts most events into few stretches, so so many times the pairs are drawn.
_DRAWN = 4
# Rows of the table of pairs that the warped events are taken from. If there are more, they are those of some rows of
# pixels in the middle of the sensor.
_MAX_ROWS = 1 << 24
# Contrast needs so many events.
_LEAST_EVENTS = 2_000
# Seconds between the poses that events are warped by, and the least and the most of these poses.
_POSE_INTERVAL = 2e-3
_LEAST_POSES, _MOST_POSES = 2_000, 100_000
# Slices of events that are tried with a camera that turns by so many pixels more from the slice's middle to its end.
# With poses that are right to a pixel, a turn makes the events clearly less sharp, about every axis.
_TURNED_SLICES = 4
_TURN_PIXELS = 1.5
# A turn makes a slice sharper if the contrast rises by so many standard errors and by such a factor.
_SHARPER_ERRORS, _SHARPER_FACTOR = 2.5, 1.03
# The share of the loss of a constant field that is left. A stretch stands out if its share is so large, and so many
# times the median. If the median itself is so large, either the poses are wrong or the training was short.
_HIGH_SHARE, _HIGH_FACTOR = 0.15, 3.0
_HIGH_MEDIAN = 0.05
# Poses still move if the last part of the run turns them by so many pixels, and by such a share of the correction.
_MOVING_PIXELS, _MOVING_SHARE = 0.25, 0.1
# The correction barely moves poses if it turns them by less than so many pixels, and shifts them by less than such a
# part of the trajectory's extent. In the runs of docs/method.md, noisy batches alone moved exact poses further.
_BARELY_PIXELS, _BARELY_EXTENTS = 0.05, 1e-3
# The clock offset is at its limit if its change is such a share of the largest one.
_CLOCK_SHARE = 0.9
# The penalty holds corrections back if it is such a share of the reconstruction loss.
_PENALTY_SHARE = 0.1


def diagnose(model: AENeRFModel, dataset: EventDataset, sampler: Sampler | None, earlier: Tensor) -> dict[str, Any]:
    """Return figures that tell whether pose correction failed, and a ``summary`` of them in words.

    Args:
        model: at the end of training, with pose correction.
        dataset: that it was trained on.
        sampler: that drew the batches.
        earlier: (N, 3, 4) corrected poses of :meth:`PoseCorrection.compared_poses`, when the last part of the run
            (:data:`LAST_PART`) began.

    Returns:
        Plain values, which JSON and checkpoints can hold; see docs/method.md.
    """
    correction, scene = model.camera_optimizer, dataset.scene
    estimated, corrected, _ = (scene.to_recording(poses) for poses in correction.compared_poses())
    # After alignment, because the scene may drift together with all poses, which changes nothing.
    size = pose_errors(corrected, estimated)
    movement = pose_errors(scene.to_recording(earlier), corrected)
    stretches = _stretches(model, sampler)
    extent = correction.translation_unit / scene.scale
    figures = {
        "correction_rotation_degrees": size["rotation_error_degrees"],
        "correction_translation_recording_units": size["translation_error"],
        "correction_translation_extents": size["translation_error"] / extent,
        "clock_change_share_of_limit": abs(float(correction.clock_change_share())),
        "last_tenth_rotation_degrees": movement["rotation_error_degrees"],
        "last_tenth_translation_recording_units": movement["translation_error"],
        "penalty_share_of_loss": _penalty_share(correction, stretches),
        **_contrast(correction, dataset),
        "stretches": stretches,
    }
    return {"summary": summary(figures, scene.event_camera.fx), **figures}


def summary(figures: dict[str, Any], focal: float) -> str:
    """Return one line: the size of the corrections, the contrast, and every clear sign of failure.

    Args:
        figures: see :func:`diagnose`.
        focal: focal length of the event camera in pixels.
    """
    degrees, moved = figures["correction_rotation_degrees"], figures["last_tenth_rotation_degrees"]
    length = round(figures["correction_translation_recording_units"], 6)
    line = f"Pose correction: {degrees:.2f} degrees and {length:.2g} units of the recording on average"
    signs = []
    turned = math.radians(degrees) * focal
    if turned < _BARELY_PIXELS and figures["correction_translation_extents"] < _BARELY_EXTENTS:
        signs.append(
            f"the correction barely moved the poses ({turned:.1g} pixels): train longer, or with a higher "
            "--optimizers.camera-opt.optimizer.lr"
        )
    if figures["clock_change_share_of_limit"] > _CLOCK_SHARE:
        signs.append(
            "the clock offset is at its limit of 0.05 s from where it began: begin with "
            "--pipeline.model.camera-optimizer.clock-offset and a value that aenerf check finds"
        )
    if figures["contrast_corrected"] is not None:
        before, after = figures["contrast_estimated"], figures["contrast_corrected"]
        line += f"; contrast of warped events {before:.3f} before, {after:.3f} after"
        if figures["contrast_is_clearly_lower"]:
            signs.append(
                "the events fit the estimated poses better than the corrected ones: train with "
                "--pipeline.model.camera-optimizer.mode off"
            )
        tried, sharper = figures["turned_slices"], figures["turned_slices_sharper"]
        if tried > 1 and 2 * sharper >= tried:
            signs.append(
                f"in {sharper} of {tried} slices, the events are clearly sharper if the camera turns a little more or "
                "less: the corrected poses are wrong, or the lens is (aenerf check)"
            )
    shares = [_share(stretch) for stretch in figures["stretches"] if stretch["loss"] is not None]
    median = float(np.median(shares)) if shares else 0.0
    times = [
        f"{stretch['start_seconds']:.3g} to {stretch['end_seconds']:.3g} s"
        for stretch in figures["stretches"]
        if stretch["loss"] is not None and _share(stretch) > max(_HIGH_FACTOR * median, _HIGH_SHARE)
    ]
    if times:
        signs.append(f"the loss is far higher from {', '.join(times)} than elsewhere: look at the poses there")
    if moved > _MOVING_SHARE * degrees and math.radians(moved) * focal > _MOVING_PIXELS:
        signs.append(f"the poses still moved by {moved:.2g} degrees in the last tenth of the run: train longer")
    share = figures["penalty_share_of_loss"]
    if share is not None and share > _PENALTY_SHARE:
        signs.append(
            f"the penalty on corrections is {share:.0%} of the reconstruction loss and holds them back: lower "
            "--pipeline.model.camera-optimizer.trans-l2-penalty and rot-l2-penalty"
        )
    if signs:
        return f"{line}. Signs of failure: {'; '.join(signs)}."
    if median > _HIGH_MEDIAN:
        return (
            f"{line}. Undecided, because {median:.0%} of the loss of a constant field is left: the training was short, "
            "the poses are wrong or the events are noisy."
        )
    return f"{line}. No sign of failure."


def _share(stretch: dict[str, Any]) -> float:
    """Return the share of the loss of a constant field that is left in a stretch."""
    return stretch["loss"] / max(stretch["loss_of_constant_field"], 1e-12)


def _penalty_share(correction: PoseCorrection, stretches: list[dict[str, Any]]) -> float | None:
    """Return the penalty on the corrections as a share of the reconstruction loss, None where the loss is unknown."""
    losses = [stretch["loss"] for stretch in stretches if stretch["loss"] is not None]
    if not losses:
        return None
    penalty: dict[str, Tensor] = {}
    with torch.no_grad():
        correction.get_loss_dict(penalty)
    return float(sum(penalty.values())) / max(float(np.mean(losses)), 1e-12)


@torch.no_grad()
def _stretches(model: AENeRFModel, sampler: Sampler | None) -> list[dict[str, Any]]:
    """Return the reconstruction loss of newly drawn pairs by stretch of time, beside the loss of a constant field.

    The list is empty where batches are not of pairs.
    """
    num_rays = 2 * _DRAWN * _NUM_STRETCHES * _PAIRS_PER_STRETCH
    drawn = None if sampler is None else sampler.residual_batch(num_rays)
    if drawn is None:
        return []
    rays, batch = drawn
    assert rays.times is not None
    num_pairs = len(batch)
    duration = model.camera_optimizer.trajectory.duration
    middle = rays.times[:, 0].unflatten(0, (2, num_pairs)).mean(0)
    stretch = (middle * (_NUM_STRETCHES / duration)).long().clamp(0, _NUM_STRETCHES - 1)
    model.eval()
    found = []
    for index in range(_NUM_STRETCHES):
        chosen = (stretch == index).nonzero()[:_PAIRS_PER_STRETCH, 0]
        losses: list[float | None] = [None, None]
        if len(chosen) >= _LEAST_PAIRS:
            outputs = model(rays[torch.cat([chosen, chosen + num_pairs])])
            constant = outputs | {"log_radiance": torch.zeros_like(outputs["log_radiance"])}
            losses = [
                float(model.supervision.losses(rendered, batch[chosen])["reconstruction_loss"])
                for rendered in (outputs, constant)
            ]
        found.append(
            {
                "start_seconds": index * duration / _NUM_STRETCHES,
                "end_seconds": (index + 1) * duration / _NUM_STRETCHES,
                "num_pairs": len(chosen),
                "loss": losses[0],
                "loss_of_constant_field": losses[1],
            }
        )
    model.train()
    return found


def _contrast(correction: PoseCorrection, dataset: EventDataset) -> dict[str, Any]:
    """Return the contrast of events warped by the estimated and the corrected poses, and by a camera that turns more.

    All values are None where there are too few events.
    """
    # Imported lazily: every ns-* command imports this module, and numba is slow to import.
    from aenerf_ns.checking.contrast import WarpedEvents
    from aenerf_ns.checking.hypotheses import Hypothesis

    camera = dataset.scene.event_camera
    surplus = max(len(dataset.pairs.rows) - _MAX_ROWS, 0)
    events = dataset.pairs.events(slice(surplus // 2 + 1, len(dataset.pairs.rows) - (surplus + 1) // 2))
    figures: dict[str, Any] = dict.fromkeys(
        (
            "contrast_estimated",
            "contrast_corrected",
            "contrast_is_clearly_lower",
            "turned_slices",
            "turned_slices_sharper",
        )
    )
    if len(events) < _LEAST_EVENTS:
        return figures
    estimated, corrected = _dense_poses(correction)
    warped = WarpedEvents([events], corrected, camera)
    comparison = warped.compare(Hypothesis("estimated", poses=lambda _: homogeneous(estimated.camera_to_worlds)))
    assert comparison is not None
    figures["contrast_estimated"] = comparison.contrast
    figures["contrast_corrected"] = comparison.given
    figures["contrast_is_clearly_lower"] = comparison.is_clearly_better
    tried = range(0, len(warped.spans), -(-len(warped.spans) // _TURNED_SLICES))
    figures["turned_slices"] = len(tried)
    figures["turned_slices_sharper"] = 0
    angle = _TURN_PIXELS / camera.fx
    # Roll is left out, because it moves the middle of the picture little.
    vectors = angle * torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=torch.float64)
    for index in tried:
        turns = (Hypothesis("turned", poses=_turn(corrected.times, warped.spans[index], vector)) for vector in vectors)
        figures["turned_slices_sharper"] += any(
            _is_sharper(warped.compare(turn, slice(index, index + 1))) for turn in turns
        )
    return figures


def _is_sharper(comparison: Comparison | None) -> bool:
    assert comparison is not None
    return comparison.difference > _SHARPER_ERRORS and comparison.contrast > _SHARPER_FACTOR * comparison.given


def _turn(times: Tensor, span: tuple[int, int], vector: Tensor) -> Callable[[Tensor], Tensor]:
    """Return a function that turns (N, 4, 4) poses at times in nanoseconds, at a steady rate within a span.

    The camera turns by -``vector`` at the start of the span, and by ``vector`` at the end.
    """
    start, end = span
    part = ((times - (start + end) / 2) / max((end - start) / 2, 1)).clamp(-1, 1)
    rotations = rotation_from_vector(part[:, None] * vector)
    turns = homogeneous(torch.cat([rotations, rotations.new_zeros(len(times), 3, 1)], -1))
    return lambda poses: poses @ turns


def _dense_poses(correction: PoseCorrection) -> tuple[Trajectory, Trajectory]:
    """Return the estimated and the corrected trajectory at the same dense times, with OpenCV axes, in the scene."""
    base = correction.trajectory
    span = base.end - base.start
    count = min(max(round(span * 1e-9 / _POSE_INTERVAL), _LEAST_POSES), _MOST_POSES)
    times = (base.start + span * torch.arange(count + 1, device=base.times.device) // count).unique()
    seconds = base.seconds(times)
    with torch.no_grad():
        estimated, corrected = (
            Trajectory(times.cpu(), homogeneous(source.pose(seconds).cpu()) @ OPENCV_TO_OPENGL)
            for source in (base, correction)
        )
    return estimated, corrected
