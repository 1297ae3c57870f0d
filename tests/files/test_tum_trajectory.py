"""Trajectories in text files, and times in seconds."""

from __future__ import annotations

from pathlib import Path

import torch
from helpers.small_datasets import make_trajectory

from aenerf_ns.files.text import format_seconds, parse_times
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory


def test_tum_trajectories_round_trip(tmp_path: Path) -> None:
    trajectory = make_trajectory()
    write_tum_trajectory(tmp_path / "poses.txt", trajectory)
    back = read_tum_trajectory(tmp_path / "poses.txt")
    assert torch.equal(back.times, trajectory.times)
    torch.testing.assert_close(back.camera_to_worlds, trajectory.camera_to_worlds, rtol=0, atol=1e-11)


def test_seconds_are_exact() -> None:
    texts = ["1600000000.123456789", "0", "1e-9", "-0.5", "12."]
    parsed = parse_times(Path("t"), texts)
    assert parsed.tolist() == [1_600_000_000_123_456_789, 0, 1, -500_000_000, 12_000_000_000]
    assert parse_times(Path("t"), [format_seconds(int(t)) for t in parsed]).tolist() == parsed.tolist()
