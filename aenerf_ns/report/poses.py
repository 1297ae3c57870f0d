"""The poses of a run: where the camera was, and how far the given and the corrected poses are from the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from aenerf_ns.camera.alignment import align, align_most, rotation_angle
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.evaluation.run import TrainedRun

# Poses that are drawn. More are not seen, and make the page large.
_MAX_DRAWN = 600


@dataclass(frozen=True)
class RunPoses:
    """Errors of all poses, and positions, errors and corrections along the trajectory, thinned.

    Attributes:
        num_poses: given poses that the true ones cover, where these are known, else all.
        seconds: (N,) since the trajectory's start.
        positions: (N, 3) of the ``estimated``, the ``corrected`` and, where they are known, the ``true`` poses in the
            recording's world, where the true trajectory is known placed on it by
            :func:`~aenerf_ns.camera.alignment.align_most`.
        upright: (3, 3) rotation of that world, after which z is up as far as the given poses tell.
        evo: :func:`evo_errors` of the ``estimated`` and the ``corrected`` poses,
            over all of them. None without true poses.
        errors: :func:`errors_over_time` of both. None without true poses.
        correction: see :func:`correction_components`. None where poses are not corrected.
    """

    num_poses: int
    seconds: list[float]
    positions: dict[str, list[list[float]]]
    upright: list[list[float]]
    evo: dict[str, dict[str, dict[str, float]]] | None
    errors: dict[str, dict[str, list[float]]] | None
    correction: dict[str, list[float]] | None


@torch.no_grad()
def measure_poses(run: TrainedRun) -> RunPoses:
    """Compute the errors of a run's poses, and where the camera was. The run is in evaluation mode."""
    psi, scene = run.model.camera_optimizer, run.scene
    given, true = scene.trajectory, scene.ground_truth
    times = given.times if true is None else given.knots_covered_by(true)
    seconds = given.seconds(times)
    poses = {"estimated": given.interpolate(times), "corrected": psi.pose(seconds.to(run.device)).cpu()}
    reference = poses["estimated"] if true is None else true.interpolate(times)
    references = dict.fromkeys(poses, reference)
    if true is None:
        # A learned clock does not turn the world.
        references["corrected"] = given.pose(psi.on_clock_of_poses(seconds.to(run.device)).cpu())
    aligned = {name: align_most(part, references[name]) for name, part in poses.items()}
    positions = {name: aligned[name](part.double()) for name, part in poses.items()}
    if true is not None:
        positions["true"] = reference
    every = -(-len(times) // _MAX_DRAWN)
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
        seconds=seconds[::every].tolist(),
        positions={name: scene.to_recording(part[::every])[..., 3].tolist() for name, part in positions.items()},
        upright=(aligned["estimated"].rotation.mT @ scene.frame.rotation).tolist(),
        evo=evo,
        errors=errors,
        correction=correction,
    )


def error_statistics(errors: Tensor) -> dict[str, float]:
    """Compute the statistics of (N,) errors that evo prints, under evo's names."""
    return {
        "max": float(errors.max()),
        "mean": float(errors.mean()),
        # torch.median would take the lower of two middle values.
        "median": float(errors.quantile(0.5)),
        "min": float(errors.min()),
        "rmse": float(errors.square().mean().sqrt()),
        "sse": float(errors.square().sum()),
        "std": float(errors.std(correction=0)),
    }


def evo_errors(poses: Tensor, reference: Tensor) -> dict[str, dict[str, float]]:
    """Compute ATE and RPE of poses, aligned by Sim(3) on their positions, as ``evo_ape -as`` and ``evo_rpe -as`` do.

    Args:
        poses: (N, 3, 4) camera-to-world.
        reference: (N, 3, 4) of the same cameras at the same times.

    Returns:
        The :func:`error_statistics` of the absolute errors ``ate``, and of the relative errors from a pose to the next:
        ``rpe_translation``, in units of the reference, and ``rpe_rotation_degrees``.
    """
    aligned = homogeneous(align(poses, reference, with_orientations=False)(poses.double()))
    reference = homogeneous(reference.double())
    steps, true_steps = (torch.linalg.solve(path[:-1], path[1:]) for path in (aligned, reference))
    relative = torch.linalg.solve(true_steps, steps)
    return {
        "ate": error_statistics((aligned - reference)[:, :3, 3].norm(dim=-1)),
        "rpe_translation": error_statistics(relative[:, :3, 3].norm(dim=-1)),
        "rpe_rotation_degrees": error_statistics(torch.rad2deg(rotation_angle(steps[:, :3], true_steps[:, :3]))),
    }


def errors_over_time(poses: Tensor, reference: Tensor) -> dict[str, list[float]]:
    """Compute the errors ``rotation_degrees`` and ``translation`` of each pose, after alignment by whole poses."""
    aligned, reference = align(poses, reference)(poses.double()), reference.double()
    return {
        "rotation_degrees": torch.rad2deg(rotation_angle(aligned, reference)).tolist(),
        "translation": (aligned - reference)[..., 3].norm(dim=-1).tolist(),
    }


def correction_components(estimated: Tensor, corrected: Tensor) -> dict[str, list[float]]:
    """Compute the motion from estimated to corrected poses (N, 3, 4), in the camera's frame, by component.

    Translations are in the units of the poses, the rotation's vector in degrees.
    """
    motion = torch.linalg.solve(homogeneous(estimated.double()), homogeneous(corrected.double()))
    vectors = Rotation.from_matrix(motion[:, :3, :3].cpu().numpy()).as_rotvec(degrees=True)
    named = {f"translation {axis}": motion[:, i, 3] for i, axis in enumerate("xyz")}
    named |= {f"rotation {axis}": vectors[:, i] for i, axis in enumerate("xyz")}
    return {name: values.tolist() for name, values in named.items()}
