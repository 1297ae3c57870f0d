"""Trajectories in text files, and times in seconds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.small_datasets import make_trajectory
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st

from aenerf_ns.errors import DataError
from aenerf_ns.files.text import format_seconds, parse_times
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory


def test_tum_trajectories_round_trip_to_the_nanosecond(tmp_path: Path) -> None:
    trajectory = make_trajectory()
    write_tum_trajectory(tmp_path / "poses.txt", trajectory)
    back = read_tum_trajectory(tmp_path / "poses.txt")
    assert torch.equal(back.times, trajectory.times)
    torch.testing.assert_close(back.camera_to_worlds, trajectory.camera_to_worlds, rtol=0, atol=1e-11)


def test_seconds_are_parsed_and_printed_exactly() -> None:
    texts = ["1600000000.123456789", "0", "1e-9", "-0.5", "12."]
    parsed = parse_times(Path("t"), texts)
    assert parsed.tolist() == [1_600_000_000_123_456_789, 0, 1, -500_000_000, 12_000_000_000]
    assert parse_times(Path("t"), [format_seconds(int(t)) for t in parsed]).tolist() == parsed.tolist()


@settings(max_examples=3 * FUZZ_EXAMPLES, deadline=None)
@given(st.text(alphabet="0123456789.-+e#\n  nai²", max_size=60), st.booleans(), st.sampled_from(["s", "us", "ns"]))
def test_no_text_crashes_the_trajectory_reader(
    tmp_path_factory: pytest.TempPathFactory, content: str, begun: bool, unit: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 " * begun + content)
    try:
        read_tum_trajectory(path, unit)  # type: ignore[arg-type]
    except DataError as error:
        assert "\n" not in str(error)  # noqa: PT017
