"""The poses of a run: where the camera was, and how far the given and the corrected poses are from the true ones."""

from __future__ import annotations

from typing import Any

import torch

from aenerf_ns.camera.alignment import align
from aenerf_ns.evaluation.poses import camera_speeds
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.report.trajectory_errors import as_evo_prints, correction_components, errors_over_time

# Poses that are drawn. More are not seen, and make the page large.
_MOST_DRAWN = 600
# A network of corrections takes some 50 kB for each pose.
_AT_ONCE = 2000


@torch.no_grad()
def measure_poses(run: TrainedRun) -> dict[str, Any]:
    """Return the errors of all poses, and positions, errors and corrections along the trajectory, thinned.

    Args:
        run: in evaluation mode.

    Returns:
        ``num_poses``: given poses that the true ones cover, where these are known, else all. ``evo``: see
        :func:`~aenerf_ns.report.trajectory_errors.as_evo_prints`, over all these poses, of the ``estimated`` and the
        ``corrected`` ones. Thinned are ``seconds`` since the trajectory's start, ``positions`` (N, 3) in units of the
        recording, with z up as far as the cameras tell, and aligned to the true trajectory where it is known,
        ``errors``, ``correction``, ``speed`` and ``turn_rate_degrees``. ``evo`` and ``errors`` are None without true
        poses, ``correction`` is None where poses are not corrected.
    """
    correction, scene = run.model.camera_optimizer, run.scene
    given, true = scene.trajectory, scene.ground_truth
    times = given.times if true is None else given.knots_covered_by(true)
    seconds = given.seconds(times)
    corrected = [correction.pose(part.to(run.device)).cpu() for part in seconds.split(_AT_ONCE)]
    poses = {"estimated": given.interpolate(times), "corrected": torch.cat(corrected)}
    reference = poses["estimated"] if true is None else true.interpolate(times)
    every = -(-len(times) // _MOST_DRAWN)
    scale = scene.scale
    positions = {name: align(one, reference)(one.double()) for name, one in poses.items()}
    if true is not None:
        positions["true"] = reference
    drawn = seconds[::every].contiguous()
    speeds, turn_rates = camera_speeds(correction, scene, drawn)
    measured: dict[str, Any] = {
        "num_poses": len(times),
        "seconds": drawn.tolist(),
        "positions": {name: (one[::every, :, 3] / scale).tolist() for name, one in positions.items()},
        "speed": speeds.tolist(),
        "turn_rate_degrees": turn_rates.tolist(),
        "evo": None,
        "errors": None,
        "correction": None,
    }
    in_recording = {name: scene.to_recording(one) for name, one in poses.items()}
    if true is not None:
        truth = scene.to_recording(reference)
        measured["evo"] = {name: as_evo_prints(one, truth) for name, one in in_recording.items()}
        measured["errors"] = {
            name: {kind: values[::every] for kind, values in errors_over_time(one, truth).items()}
            for name, one in in_recording.items()
        }
    if correction.is_learned:
        estimated, moved = (in_recording[name][::every] for name in ("estimated", "corrected"))
        measured["correction"] = correction_components(estimated, moved)
    return measured
