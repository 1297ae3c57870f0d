"""The poses of a run: where the camera was, and how far the given and the corrected poses are from the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from aenerf_ns.camera.alignment import align
from aenerf_ns.evaluation.poses import camera_speeds
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.report.trajectory_errors import correction_components, errors_over_time, evo_errors

# Poses that are drawn. More are not seen, and make the page large.
_MAX_DRAWN = 600
# Poses corrected at once. A network of corrections takes some 50 kB for each pose.
_CHUNK = 2000


@dataclass(frozen=True)
class RunPoses:
    """Errors of all poses, and positions, errors and corrections along the trajectory, thinned.

    Attributes:
        num_poses: given poses that the true ones cover, where these are known, else all.
        seconds: (N,) since the trajectory's start.
        positions: (N, 3) of the ``estimated``, the ``corrected`` and, where they are known, the ``true`` poses in
            units of the recording, with z up as far as the cameras tell. Aligned to the true trajectory where it is
            known.
        speed: (N,) units of the recording per second.
        turn_rate_degrees: (N,) per second.
        evo: :func:`~aenerf_ns.report.trajectory_errors.evo_errors` of the ``estimated`` and the ``corrected`` poses,
            over all of them. None without true poses.
        errors: :func:`~aenerf_ns.report.trajectory_errors.errors_over_time` of both. None without true poses.
        correction: see :func:`~aenerf_ns.report.trajectory_errors.correction_components`. None where poses are not
            corrected.
    """

    num_poses: int
    seconds: list[float]
    positions: dict[str, list[list[float]]]
    speed: list[float]
    turn_rate_degrees: list[float]
    evo: dict[str, dict[str, dict[str, float]]] | None
    errors: dict[str, dict[str, list[float]]] | None
    correction: dict[str, list[float]] | None


@torch.no_grad()
def measure_poses(run: TrainedRun) -> RunPoses:
    """Compute the errors of a run's poses, and where the camera was.

    Args:
        run: in evaluation mode.
    """
    psi, scene = run.model.camera_optimizer, run.scene
    given, true = scene.trajectory, scene.ground_truth
    times = given.times if true is None else given.knots_covered_by(true)
    seconds = given.seconds(times)
    corrected = [psi.pose(part.to(run.device)).cpu() for part in seconds.split(_CHUNK)]
    poses = {"estimated": given.interpolate(times), "corrected": torch.cat(corrected)}
    reference = poses["estimated"] if true is None else true.interpolate(times)
    positions = {name: align(part, reference)(part.double()) for name, part in poses.items()}
    if true is not None:
        positions["true"] = reference
    every = -(-len(times) // _MAX_DRAWN)
    drawn = seconds[::every].contiguous()
    speeds, turn_rates = camera_speeds(psi, scene, drawn)
    in_recording = {name: scene.to_recording(part) for name, part in poses.items()}
    evo = errors = correction = None
    if true is not None:
        truth = scene.to_recording(reference)
        evo = {name: evo_errors(part, truth) for name, part in in_recording.items()}
        errors = {
            name: {kind: values[::every] for kind, values in errors_over_time(part, truth).items()}
            for name, part in in_recording.items()
        }
    if psi.is_learned:
        correction = correction_components(in_recording["estimated"][::every], in_recording["corrected"][::every])
    return RunPoses(
        num_poses=len(times),
        seconds=drawn.tolist(),
        positions={name: (part[::every, :, 3] / scene.scale).tolist() for name, part in positions.items()},
        speed=speeds.tolist(),
        turn_rate_degrees=turn_rates.tolist(),
        evo=evo,
        errors=errors,
        correction=correction,
    )
