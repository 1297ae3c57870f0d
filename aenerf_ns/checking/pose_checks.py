"""Check the poses alone: gaps between them, poses that stand still, jumps, and the motion between events."""

from __future__ import annotations

import numpy as np
import torch

from aenerf_ns.camera.alignment import rotation_angle
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.checking.result import CheckResult
from aenerf_ns.recording.poses_report import read_poses_report
from aenerf_ns.recording.recording import Recording

_MAX_GAPS_SHOWN = 5
# Share of the events that have a pose.
_MIN_COVERED_SHARE = 0.5
# A gap is longer than this many median intervals of the poses. This share of the events may fall in gaps, and of the
# time in gaps with less than this share of the mean rate.
_GAP_FACTOR, _MAX_GAP_SHARE, _MIN_GAP_RATE = 5, 0.01, 0.01
# Poses that differ by less are equal. This share of the events may fall between equal poses.
_EQUAL_POSES, _MAX_STILL_SHARE = 1e-12, 0.05
# A jump is faster than the steps around it, and than the median, by this factor.
_JUMP_FACTOR = 5
# Radians. Poses at rest turn by less, by the last digit of their quaternions.
_MIN_TURN = 1e-4


def check_poses(result: CheckResult, recording: Recording, window: TimeWindow, num_posed: int) -> None:
    """Describe the poses, and look for events without one and for gaps."""
    statistics, figures, problems = result.statistics, result.figures, result.problems
    trajectory = recording.trajectory
    times = trajectory.times.numpy()
    intervals = np.diff(times)
    median = float(np.median(intervals))
    degrees = torch.rad2deg(rotation_angle(trajectory.camera_to_worlds[:-1], trajectory.camera_to_worlds[1:]))
    steps = trajectory.camera_to_worlds[..., 3].diff(dim=0).norm(dim=-1)
    figures.append(
        f"Poses: {len(trajectory)} from {trajectory.start} to {trajectory.end} ns, {1e9 / median:.1f} a second; "
        f"between two of them at most {degrees.max():.2g} degrees and {steps.max():.2g} of their units; the path "
        f"is {steps.sum():.3g} long"
    )
    estimation = read_poses_report(trajectory)
    if estimation is not None:
        figures.append(f"How they were found: {estimation.summary}")
    if recording.intrinsics_origin == "estimated":
        figures.append(f"The intrinsics were estimated with the poses: {recording.event_camera.summary()}")
    if recording.ground_truth is not None:
        figures.append(f"True poses: {len(recording.ground_truth)}, for evaluation")
    covered = num_posed / statistics.num_events
    figures.append(f"Events with a pose: {covered:.1%}")
    if covered < _MIN_COVERED_SHARE:
        problems.append(
            f"only {covered:.1%} of the events have a pose, the others are not used: check the clocks of events and "
            "poses, or cut the recording"
        )
    # The gaps of the window were already reported when the dataset was opened.
    known = np.isin(times[:-1], [first for first, _ in window.gaps])
    gaps = np.flatnonzero((intervals > _GAP_FACTOR * median) & ~known)
    if len(gaps):
        # The shares are those of the sampled pairs, each counted at its later event.
        later = np.searchsorted(times, statistics.pair_times[:, 1])
        all_shares = np.bincount(later, minlength=len(times) + 1)[1 : len(times)] / max(len(later), 1)
        shares = all_shares[gaps]
        time_shares = np.diff(times.clip(window.start, window.end))[gaps] / (window.end - window.start)
        # Poses of images of events are further apart where the camera is slow, with as many events in between.
        is_busy = shares > _GAP_FACTOR * np.median(all_shares)
        # A window that was chosen may leave gaps out.
        share = shares[is_busy & (times[gaps] < window.end) & (times[gaps + 1] > window.start)].sum()
        # Pairs of events span what lies between two recordings that were joined. A slow camera has some events, and a
        # camera that rests goes on from where it was.
        has_moved = ((steps > _JUMP_FACTOR * steps.median()) | (degrees > _JUMP_FACTOR * degrees.median())).numpy()
        empty_share = time_shares[(shares < _MIN_GAP_RATE * time_shares) & has_moved[gaps]].sum()
        longest = gaps[np.argsort(-intervals[gaps], kind="stable")[:_MAX_GAPS_SHOWN]]
        named = ", ".join(f"{intervals[i] * 1e-9:.3f} s after {times[i]} ns" for i in longest)
        figures.append(f"Gaps between poses: {len(gaps)}, with {shares.sum():.1%} of the events; the longest: {named}")
        where = ""
        if share > _MAX_GAP_SHARE:
            where = f"{share:.1%} of the events fall in gaps between poses"
        elif empty_share > _MAX_GAP_SHARE:
            where = f"{empty_share:.1%} of the time is in gaps between poses without events, as of joined recordings"
        if where:
            problems.append(
                f"{where}, where poses are interpolated: give the missing poses, or leave the gaps out "
                "(--max-pose-gap-ns of the dataparser)"
            )


def check_steps(result: CheckResult, trajectory: Trajectory, window: TimeWindow) -> None:
    """Look for poses that stand still while there are events, or jump."""
    times, poses = trajectory.times.numpy(), trajectory.camera_to_worlds
    still = np.flatnonzero(((poses[1:] - poses[:-1]).abs().flatten(1).amax(1) < _EQUAL_POSES).numpy())
    later = result.statistics.pair_times[:, 1]
    later = later[window.contains(later)]
    share = float(np.isin(np.searchsorted(times, later) - 1, still).mean()) if len(later) else 0.0
    if share > _MAX_STILL_SHARE:
        result.problems.append(
            f"{share:.1%} of the events fall between poses that are equal (the first at {times[still[0]]} ns): "
            "tracking may have been lost there, or poses were repeated; leave these poses out, and see "
            "--max-pose-gap-ns"
        )
    seconds = np.diff(times) * 1e-9
    jumps = np.zeros(len(seconds), bool)
    turns, moves = rotation_angle(poses[:-1], poses[1:]), poses[..., 3].diff(dim=0).norm(dim=-1)
    for steps, least in ((turns.numpy(), _MIN_TURN), (moves.numpy(), 0.0)):
        rates = steps / seconds
        padded = np.pad(rates, 3, mode="edge")
        around = np.max([padded[3 + k : 3 + k + len(rates)] for k in (-3, -2, 2, 3)], 0)
        jumps |= (rates > _JUMP_FACTOR * np.maximum(around, np.median(rates))) & (steps > least)
    jumps &= window.contains(times[:-1]) & window.contains(times[1:])
    if jumps.any():
        result.problems.append(
            f"the poses jump (steps: {jumps.sum()}, the first after {times[:-1][jumps][0]} ns): tracking may have been "
            "lost there, or placeholders stand among the poses; leave these poses out"
        )
