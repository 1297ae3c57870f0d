"""The windows that ``aenerf check`` is measured on: a right one has no problem, and a mistake in one is counted."""

from pathlib import Path

from helpers.commands import simulate

from aenerf_ns.cli.dataset import DatasetCommand
from aenerf_ns.events.stream import EventStream
from benchmarks.check_windows import MISTAKES, find_problems, table


def test_mistakes_are_found_in_a_window(tmp_path: Path) -> None:
    room = simulate(tmp_path / "room", "--width", "32", "--height", "24", "--max-displacement", "1")
    recording = DatasetCommand(room).open_dataset().recording
    events = EventStream.concatenate(list(recording.event_file.chunks()))
    found = []
    for kind, change in (("right", lambda *given: given), *MISTAKES.items()):
        given = change(events, recording)
        if kind in ("right", "events binned by 2", "times of the poses in microseconds"):
            problems, has_enough = find_problems(*given, 0, 1_000_000_000)
            found.append({"kind": kind, "enough_events": has_enough, "problems": problems})
    assert [one["problems"] for one in table(found).values()] == [0, 1, 1]
    assert any("16 x 12 of 32 x 24 pixels" in problem for problem in found[2]["problems"])
