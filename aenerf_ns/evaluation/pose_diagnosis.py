"""Judge pose correction at the end of training, without ground truth."""

from __future__ import annotations

import math
from typing import Any

import torch

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous
from aenerf_ns.checking.hypotheses import Comparison, Hypothesis
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun

# Poses are not corrected if they are turned by less than this in radians, and moved by less than this in extents of
# the trajectory. Noisy batches alone move exact poses further.
_MIN_CORRECTION = 5e-4
# The clock offset is at its limit if its change is above this share of the greatest one.
_MAX_CLOCK_SHARE = 0.9
# A stretch is weak if more than this share of the loss of a constant field is left. After 1200 steps of aenerf-small,
# runs with mended poses leave 1 to 9 % and runs with wrong ones 10 to 35 % (benchmarks/LOG.md).
_MAX_LOSS_SHARE = 0.15
# Stretches hold equally many of the drawn pairs.
_NUM_STRETCHES, _PAIRS_PER_STRETCH = 10, 512
# Poses that events are warped by.
_NUM_POSES = 10_000


def diagnose(run: TrainedRun) -> dict[str, Any]:
    """Measure figures that tell whether the pose correction of a run failed, at the end of its training.

    Returns:
        The figures and a ``summary`` of them in words, as plain values, which JSON and checkpoints can hold. The
        contrasts are None where too few events can be read, and there are no stretches where batches are not of pairs.
    """
    correction, scene = run.model.camera_optimizer, run.dataset.scene
    estimated, corrected, _ = (scene.to_recording(poses) for poses in correction.compared_poses())
    # After alignment, because the scene may drift together with all poses, which changes nothing.
    size = pose_errors(corrected, estimated)
    comparison = _compare_contrast(run)
    figures: dict[str, Any] = {
        "correction_rotation_degrees": size["rotation_error_degrees"],
        "correction_translation_recording_units": size["translation_error"],
        "correction_translation_extents": size["translation_error"] * scene.scale / correction.translation_unit,
        "clock_change_share_of_limit": abs(float(correction.clock_change_share())),
        "contrast_estimated": None if comparison is None else comparison.contrast,
        "contrast_corrected": None if comparison is None else comparison.given,
        "contrast_is_clearly_lower": comparison is not None and comparison.is_clearly_better,
        "stretches": _measure_stretches(run),
    }
    return {"summary": summarize(figures), **figures}


def summarize(figures: dict[str, Any]) -> str:
    """Say in one line how large the corrections are, and name every sign of failure in :func:`diagnose`'s figures."""
    degrees, length = figures["correction_rotation_degrees"], figures["correction_translation_recording_units"]
    line = f"Pose correction: {degrees:.2f} degrees and {round(length, 6):.2g} units of the recording on average"
    before, after = figures["contrast_estimated"], figures["contrast_corrected"]
    if before is not None:
        line += f"; contrast of warped events {before:.3f} before, {after:.3f} after"
    signs = []
    if max(math.radians(degrees), figures["correction_translation_extents"]) < _MIN_CORRECTION:
        signs.append("poses not corrected (train longer, or raise --optimizers.camera-opt.optimizer.lr)")
    if figures["contrast_is_clearly_lower"]:
        signs.append(
            "turned too far: the events fit the estimated poses better (train with "
            "--pipeline.model.camera-optimizer.mode off, and without its rigid-offset and clock-offset)"
        )
    if figures["clock_change_share_of_limit"] > _MAX_CLOCK_SHARE:
        signs.append(
            "clock at its limit of 0.05 s from where it began (begin with "
            "--pipeline.model.camera-optimizer.clock-offset and a value that aenerf check finds)"
        )
    shares = [part["loss"] / max(part["loss_of_constant_field"], 1e-12) for part in figures["stretches"]]
    num_weak = sum(share > _MAX_LOSS_SHARE for share in shares)
    if num_weak:
        worst = max(range(len(shares)), key=shares.__getitem__)
        part = figures["stretches"][worst]
        signs.append(
            f"weak stretches: {num_weak} of {len(shares)}, the worst from {part['start_seconds']:.3g} to "
            f"{part['end_seconds']:.3g} s with {shares[worst]:.0%} of the loss of a constant field (train with poses "
            "that aenerf convert --poses refined has mended, train longer, or expect noise)"
        )
    verdict = f"Signs of failure: {'; '.join(signs)}" if signs else "No sign of failure"
    return f"{line}. {verdict}."


@torch.no_grad()
def _measure_stretches(run: TrainedRun) -> list[dict[str, float]]:
    """Measure the reconstruction loss of newly drawn pairs by stretch of time, beside the loss of a constant field."""
    model, sampler = run.model, run.sampler
    drawn = None if sampler is None else sampler.residual_batch(2 * _NUM_STRETCHES * _PAIRS_PER_STRETCH)
    if drawn is None:
        return []
    rays, batch = drawn
    middle = rays.times[:, 0].unflatten(0, (2, len(batch))).mean(0)
    model.eval()
    stretches = []
    for chosen in middle.argsort().chunk(_NUM_STRETCHES):
        outputs = model(rays[torch.cat([chosen, chosen + len(batch)])])
        constant = outputs | {"log_radiance": torch.zeros_like(outputs["log_radiance"])}
        stretch = {"start_seconds": float(middle[chosen[0]]), "end_seconds": float(middle[chosen[-1]])}
        for name, rendered in (("loss", outputs), ("loss_of_constant_field", constant)):
            stretch[name] = float(model.supervision.losses(rendered, batch[chosen])["reconstruction_loss"])
        stretches.append(stretch)
    model.train()
    return stretches


def _compare_contrast(run: TrainedRun) -> Comparison | None:
    """Compare the contrast of events warped by the estimated and by the corrected poses.

    None where too few events can be read, or get a direction from the lens.
    """
    # Imported lazily: every ns-* command imports this module, and numba is slow to import.
    from aenerf_ns.checking.contrast import WarpedEvents, read_runs

    correction = run.model.camera_optimizer
    file, camera, window = run.scene.event_file, run.scene.event_camera, run.scene.window
    try:
        num_covered = sum(int(window.contains(chunk.t).sum()) for chunk in file.chunks())
        runs = read_runs(file, camera, window, num_covered)
    except DataError:
        # A method that trains on images has not read the events. They must not end it before its last checkpoint.
        return None
    if not runs:
        return None
    base = correction.trajectory
    num_poses = _NUM_POSES // len(runs)
    shares = torch.arange(num_poses + 1)
    spans = [(int(part.t[0]), int(part.t[-1])) for part in runs]
    times = torch.cat([start + (end - start) * shares // num_poses for start, end in spans]).unique()
    with torch.no_grad():
        estimated, corrected = (
            homogeneous(source.pose(base.seconds(times.to(base.times.device))).cpu()) @ OPENCV_TO_OPENGL
            for source in (base, correction)
        )
    warped = WarpedEvents(runs, Trajectory(times, corrected), camera)
    return warped.compare(Hypothesis("estimated", poses=lambda _: estimated))
