"""The check of a dataset: true poses beat wrong poses, and a planted mistake is named."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.commands import simulate
from helpers.dataset_faults import edit_json, set_in
from helpers.own_recordings import random_events, write_calibration, write_poses
from helpers.small_datasets import read_native
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, Trajectory
from aenerf_ns.checking.contrast import WarpedEvents
from aenerf_ns.checking.contrast_checks import check_contrast, check_depth
from aenerf_ns.checking.event_checks import check_thresholds
from aenerf_ns.checking.hypotheses import clock_hypothesis
from aenerf_ns.checking.pose_checks import check_poses
from aenerf_ns.checking.report import check
from aenerf_ns.cli.check import Check
from aenerf_ns.cli.convert import Convert
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_hdf5 import Hdf5EventWriter
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.recording.recording import Recording
from benchmarks.check_windows import MISTAKES as PLANTED
from benchmarks.check_windows import shift_clock

# Part of the simulated recording that is looked at, in nanoseconds: four slices.
PART = 1_300_000_000


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    views = ("--train-images", "12", "--validation-views", "1", "--test-views", "1")
    options = ("--width", "64", "--height", "48", "--max-displacement", "1", *views)
    return simulate(tmp_path_factory.mktemp("check") / "room", *options)


def all_events(recording: Recording) -> EventStream:
    return EventStream.concatenate(list(recording.event_file.chunks()))


@pytest.fixture(scope="module")
def simulated(room: Path) -> tuple[Recording, EventStream]:
    recording = read_native(room)
    return recording, all_events(recording).between(0, PART)


def named(events: EventStream, recording: Recording) -> list[str]:
    """Return the names of the alternatives that are clearly better, the best first."""
    trajectory = recording.trajectory
    covered = events.between(trajectory.start, trajectory.end)
    warped = WarpedEvents([covered], trajectory, recording.event_camera)
    return [c.hypothesis.name for c in warped.compare_alternatives() if c.is_clearly_better]


MISTAKES = {
    "the poses have OpenGL camera axes (y up, z backward)": PLANTED["OpenGL camera axes"],
    "the camera axes x and y are flipped (a camera upside down)": PLANTED["camera axes x and y flipped"],
    "the camera axes x and z are flipped": PLANTED["camera axes x and z flipped"],
    "the poses are world-to-camera": PLANTED["world-to-camera"],
    "the poses are world-to-camera with OpenGL camera axes": lambda *given: PLANTED["world-to-camera"](
        *PLANTED["OpenGL camera axes"](*given)
    ),
    "the quaternions have w first": PLANTED["quaternions with w first"],
    "the pixels are mirrored in x": PLANTED["pixels mirrored in x"],
    "the pixels are mirrored in y": PLANTED["pixels mirrored in y"],
    "x and y of the events are swapped": PLANTED["x and y swapped"],
}


def test_no_slice_spans_a_gap_of_the_poses(simulated: tuple[Recording, EventStream]) -> None:
    recording, _ = simulated
    gaps = ((PART // 4, PART // 2), (3 * PART // 5, 3 * PART // 4))
    warped = check(recording, recording.frames, TimeWindow(0, PART, gaps)).warped
    assert not any(first < end and last > start for first, last in warped.spans for start, end in gaps)
    # From all three stretches.
    assert warped.spans[0][0] < gaps[0][0]
    assert warped.spans[-1][1] > gaps[1][1]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_name_a_planted_mistake(mistake: str, simulated: tuple[Recording, EventStream]) -> None:
    recording, events = simulated
    found = named(*MISTAKES[mistake](events, recording))
    assert found[:1] == [mistake]


@pytest.mark.parametrize(("side", "seconds"), [("ahead of", 0.2), ("behind", -0.2)])
def test_name_and_measure_a_shifted_clock(side: str, seconds: float, simulated: tuple[Recording, EventStream]) -> None:
    recording, events = simulated
    best, *_ = named(*shift_clock(seconds)(events, recording))
    found = best.removeprefix("the clock of the poses is ").removesuffix(f" s {side} that of the events")
    assert float(found) == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize(("given", "factor"), [(1.5, "0.67"), (0.5, "2")])
def test_name_focal_lengths_that_do_not_fit(
    given: float, factor: str, simulated: tuple[Recording, EventStream]
) -> None:
    recording, events = simulated
    camera = recording.event_camera
    lens = replace(recording, event_camera=replace(camera, fx=given * camera.fx, fy=given * camera.fy))
    found = named(events, lens)
    assert found[0] == f"the focal lengths are about {factor} times the given ones"


def test_clock_remedy_names_the_learning_option() -> None:
    for offset, option in ((20_000_000, "clock-offset 0.02"), (-50_000_000, "clock-offset -0.05"), (2 * 10**9, None)):
        remedy = clock_hypothesis(offset).remedy
        assert ("clock-offset" in remedy) == (option is not None)
        assert option is None or option in remedy


def run(folder: Path, *, status: int | None = None, **options: Any) -> str:
    """Return the output of the check. It must end with an exit status, if one is given."""
    ended = 0
    with CONSOLE.capture() as output:
        try:
            Check(folder, **options).main()
        except SystemExit as end:
            ended = int(end.code or 0)
    assert status in (None, ended), output.get()
    return output.get()


# What is left of each column is that of the recording. To permute all but the times is to permute the times.
@pytest.mark.parametrize("columns", ["p", "xy", "xyp"])
def test_reject_noise(columns: str, shorter: Path) -> None:
    events = all_events(read_native(shorter))
    order = np.random.default_rng(0).permutation(len(events))
    rewrite(shorter, replace(events, **{name: getattr(events, name)[order] for name in columns}))
    output = run(shorter, status=1)
    assert "hardly sharper than the same events in a random order" in output


def test_reject_poses_of_another_path(shorter: Path) -> None:
    change_poses(shorter, lambda poses: poses.flip(0))
    run(shorter, status=1)


@pytest.fixture
def shorter(room: Path, tmp_path: Path) -> Path:
    """The simulated room with a part of its events."""
    folder = shutil.copytree(room, tmp_path / "room")
    rewrite(folder, all_events(read_native(folder)).between(0, PART))
    return folder


def rewrite(folder: Path, events: EventStream) -> None:
    with Hdf5EventWriter(folder / "events.h5") as writer:
        writer.append(events)


def change_poses(folder: Path, function: Callable[[torch.Tensor], torch.Tensor]) -> None:
    path = folder / "trajectory_estimated.txt"
    write_tum_trajectory(path, read_tum_trajectory(path).transform(function))


# The end of a line that proposes another threshold.
OPTION = "guess, give the format --positive-contrast-threshold "


def test_command_finds_nothing_and_draws_a_picture(shorter: Path, tmp_path: Path) -> None:
    set_in("transforms.json", "scene_box", value=[[-8.0] * 3, [8.0] * 3])(shorter)
    set_in("transforms.json", "event_camera", "positive_contrast_threshold", value=0.4)(shorter)
    output = run(shorter, status=0, picture=tmp_path / "warped.png")
    assert "No problems found" in output
    count = len(all_events(read_native(shorter)))
    assert f"Events: {count:,} in 1." in output
    assert "Events with a pose: 100.0%" in output
    assert "Within the scene box: 100" in output
    assert "change from frame to frame: +0.9" in output
    assert "by the frames, C- is 0.2" in output
    assert "(given: 1.60)" in output
    assert number_after(OPTION, output) == pytest.approx(0.25, abs=0.02)
    # The camera is well inside a room of some meters.
    near, far = (float(output.split("What is seen is ")[1].split()[i]) for i in (0, 2))
    assert 0.3 < near < 2 < far < 8
    with Image.open(tmp_path / "warped.png") as picture:
        assert picture.size == (128 * 10, 480)


def test_command_names_reversed_polarities_and_a_small_scene_box(shorter: Path) -> None:
    events = all_events(read_native(shorter))
    rewrite(shorter, replace(events, p=-events.p))
    set_in("transforms.json", "scene_box", value=[[-0.5] * 3, [0.5] * 3])(shorter)
    set_in("transforms.json", "event_camera", "positive_contrast_threshold", value=0.4)(shorter)
    output = run(shorter, status=1)
    assert "the scene box holds only" in output
    assert "change from frame to frame: -0.9" in output
    assert "the polarities look reversed" in output
    # They reverse the ratio of the thresholds.
    assert "(given: 1.60)" in output
    assert OPTION not in output
    assert "by the frames, C- is 0.2" not in output


def test_command_names_mistakes_and_remedies(room: Path, shorter: Path) -> None:
    change_poses(shorter, torch.linalg.inv)
    # Slices are long where a hot pixel is sharp in all of them.
    events = all_events(read_native(room)).between(0, 2 * PART)
    rng = np.random.default_rng(0)
    t = np.concatenate([events.t, np.sort(rng.integers(0, 2 * PART, 6000))])
    order = np.argsort(t, kind="stable")
    x, y = np.append(events.x, np.full(6000, 11, np.uint16)), np.append(events.y, np.full(6000, 7, np.uint16))
    p = np.append(events.p, np.ones(6000, np.int8))
    whole_milliseconds = t[order] // 1_000_000 * 1_000_000
    rewrite(shorter, EventStream(x[order], y[order], whole_milliseconds, p[order], 64, 48))
    output = run(shorter, status=1)
    assert "all times of events are whole milliseconds" in output
    assert "as if the poses are world-to-camera" in output
    assert "invert each" in output
    assert "hot pixels make" in output
    assert "--drop-hot-pixels" in output
    assert "(11, 7) 6," in output


def test_command_reports_gaps_and_missing_poses(shorter: Path) -> None:
    path = shorter / "trajectory_estimated.txt"
    poses = read_tum_trajectory(path)
    kept = (poses.times < 200_000_000) | ((poses.times > 400_000_000) & (poses.times < 560_000_000))
    write_tum_trajectory(path, Trajectory(poses.times[kept], poses.camera_to_worlds[kept]))
    events = all_events(read_native(shorter))
    one = np.ones(len(events), np.int8)
    rewrite(shorter, EventStream(events.x, events.y, events.t, one, 64, 48))
    output = run(shorter, status=1)
    assert "Gaps between poses: 1" in output
    assert "of the events fall in gaps" in output
    assert "of the events have a pose, the others are not used" in output
    assert "100.0% of the events are positive" in output


@pytest.mark.parametrize("is_slow", [True, False])
def test_poses_of_a_slow_camera_are_no_gaps(is_slow: bool) -> None:
    """Give 50 poses every 10 ms, then 5 every 100 ms, and as many events between each two, or all evenly in time."""
    times = np.cumsum([0] + [10_000_000] * 50 + [100_000_000] * 5)
    ends = np.linspace(0, 55, 5500, endpoint=False) if is_slow else np.linspace(0, times[-1], 5500, endpoint=False)
    ends = np.interp(ends, np.arange(56), times) if is_slow else ends
    poses = torch.eye(4, dtype=torch.float64)[:3].repeat(56, 1, 1)
    poses[:, 0, 3] = torch.arange(56)
    trajectory = Trajectory(torch.from_numpy(times), poses, "made")
    recording = SimpleNamespace(trajectory=trajectory, intrinsics_origin="given", ground_truth=None)
    statistics = SimpleNamespace(pair_times=np.stack([ends, ends], 1), num_events=5500)
    result = SimpleNamespace(statistics=statistics, figures=[], problems=[])
    check_poses(result, recording, trajectory.known_time(), 5500)
    assert "Gaps between poses: 5" in result.figures[-1]
    assert ["50.0% of the events fall in gaps" in problem for problem in result.problems] == [True] * (not is_slow)


def test_a_gap_between_joined_recordings_is_a_problem(tmp_path: Path) -> None:
    first, second = (random_events(1.0, start, 1000) for start in (0.0, 9.0))
    np.savez(tmp_path / "events.npz", **{name: np.append(first[name], second[name]) for name in first})
    write_calibration(tmp_path / "calibration.json")
    write_poses(tmp_path / "trajectory.txt", seconds=10.0)
    # A camera that stands still has poses.
    assert "gaps between poses" not in run(tmp_path)
    lines = (tmp_path / "trajectory.txt").read_text().splitlines(keepends=True)
    (tmp_path / "trajectory.txt").write_text("".join(lines[:101] + lines[900:]))
    assert "80.0% of the time is in gaps between poses without events" in run(tmp_path)
    assert "gaps between poses" not in run(tmp_path, format_options=("max-pose-gap-ns=100000000",))
    # Nor is a rest a problem, in which poses from events have a gap.
    poses = [line.split(maxsplit=1)[1] for line in lines[101:202]]
    later = [f"{line.split()[0]} {pose}" for line, pose in zip(lines[900:], poses, strict=True)]
    (tmp_path / "trajectory.txt").write_text("".join(lines[:101] + later))
    assert "gaps between poses" not in run(tmp_path)


def test_a_chosen_time_window_is_no_lack_of_poses(tmp_path: Path) -> None:
    np.savez(tmp_path / "events.npz", **random_events(10.0, 0.0, 1000))
    write_calibration(tmp_path / "calibration.json")
    write_poses(tmp_path / "trajectory.txt", seconds=10.0)
    window = "start-time-ns=2000000000", "end-time-ns=4000000000"
    output = run(tmp_path, format_options=window)
    assert "Events with a pose: 100.0%" in output
    assert "the others are not used" not in output
    # Nor is what is wrong with the poses of other times a problem.
    lines = (tmp_path / "trajectory.txt").read_text().splitlines(keepends=True)
    still = [f"{line.split()[0]} 6 0 0 0 0 0 1\n" for line in lines[600:800]]
    (tmp_path / "trajectory.txt").write_text("".join(lines[:50] + lines[150:600] + still + lines[800:]))
    problems = "of the events fall in gaps", "of the events fall between poses that are equal"
    for options in ((), window):
        output = run(tmp_path, format_options=options)
        assert [problem in output for problem in problems] == [not options] * 2


def test_few_events_are_not_warped(native: Path, tmp_path: Path) -> None:
    picture = tmp_path / "warped.png"
    output = run(native, picture=picture)
    assert "Contrast of warped events: not computed, because no 2000 events have poses without" in output
    assert f"{picture}: not written" in output
    assert not picture.exists()


def test_the_events_of_a_bare_file_are_checked(room: Path, tmp_path: Path) -> None:
    file = tmp_path / "my recording.h5"
    shutil.copy(room / "events.h5", file)
    camera = json.loads((room / "transforms.json").read_text())["event_camera"]
    (tmp_path / "calibration.json").write_text(json.dumps({"event_camera": camera}))
    options = ("negative-contrast-threshold=0.5", "scale-factor=2", "start-time-ns=1")
    output = run(file, status=0, format_options=options, picture=tmp_path / "no.png")
    assert "Events: " in output
    assert "no.png: not written" in output
    command = (
        f"aenerf convert '{file}' --output FOLDER --poses events --start-time-ns 1 --format-options negative-contrast"
    )
    assert f"There are no poses at {tmp_path / 'trajectory.txt'}. Find them with: {command}-threshold=0.5\n" in output
    # The files beside the event file are parts of the recording.
    swapped = {**camera, "cx": camera["cy"], "cy": camera["cx"]}
    (tmp_path / "calibration.json").write_text(json.dumps({"event_camera": swapped}))
    output = run(file, status=1)
    assert "x and y swapped" in output
    shutil.copy(room / "trajectory_estimated.txt", tmp_path / "trajectory.txt")
    assert "Events with a pose: 100.0%" in run(file)


def number_after(words: str, output: str) -> float:
    return float(output.split(words)[1].split()[0])


def test_real_recording_prefers_its_poses_and_is_compared_with_frames(
    slider_depth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compare, found = WarpedEvents.compare_alternatives, []
    monkeypatch.setattr(WarpedEvents, "compare_alternatives", lambda warped: found.extend(compare(warped)) or found)
    # The poses sharpen the events, and no alternative fits better.
    output = run(slider_depth, status=0, picture=tmp_path / "warped.png")
    # Twice 240 x 180, twice enlarged: its tiles reach beyond the sensor.
    with Image.open(tmp_path / "warped.png") as picture:
        assert picture.size == (960, 360)
    # The camera moves along its x axis and does not turn, so that mistakes that keep this axis do not show.
    unseen = {"the poses have OpenGL camera axes (y up, z backward)", "the pixels are mirrored in y"}
    of = {comparison.hypothesis.name: comparison for comparison in found}
    for name in (*MISTAKES, *(clock_hypothesis(offset).name for offset in (100_000_000, 500_000_000))):
        assert of[name].is_inconclusive if name in unseen else of[name].is_clearly_worse, name
    assert number_after("change from frame to frame: ", output) > 0.7
    # No file states the thresholds. Of the balance of 50,000 polarities and of three pairs of frames, each alone:
    assert "(assumed: 1.00)" in output
    ratio = number_after("C+/C- is ", output)
    assert 1.2 < ratio < 1.5
    assert 0.35 < number_after("by the frames, C- is ", output) < 0.65
    option = number_after("ecd-data --positive-contrast-threshold ", output)
    assert option == pytest.approx(0.5 * ratio, abs=0.004)


def test_frames_that_hardly_fit_tell_no_thresholds() -> None:
    result: Any = SimpleNamespace(figures=[], sensor_options={})
    capture: Any = SimpleNamespace(sensor=SensorModel(), has_assumed_thresholds=True)
    changes: Any = SimpleNamespace(negative_threshold=lambda _: (0.08, 0.08, 0.08), bandwidth=lambda _: (9.0, 9.0, 9.0))
    balance: Any = SimpleNamespace(ratio=lambda: (1.0, 0.1))
    check_thresholds(result, capture, changes, balance, 0.32)
    assert len(result.figures) == 1
    assert "by the frames" not in result.figures[0]
    check_thresholds(result, capture, changes, balance, 0.7)
    assert "by the frames, C- is 0.08" in result.figures[1]


def test_the_last_digit_of_poses_at_rest_is_no_jump(shorter: Path) -> None:
    def drift(poses: torch.Tensor) -> torch.Tensor:
        # A slider, and a turn of 0.01 degrees with six digits.
        moved = torch.eye(4, dtype=poses.dtype).repeat(len(poses), 1, 1)
        moved[:, 0, 3] = torch.arange(len(poses)) * 0.01
        angles = 2 * torch.linspace(0, 1e-4, len(poses), dtype=poses.dtype).round(decimals=6)
        moved[:, 0, 0] = moved[:, 1, 1] = angles.cos()
        moved[:, 1, 0], moved[:, 0, 1] = angles.sin(), -angles.sin()
        return moved

    change_poses(shorter, drift)
    assert "the poses jump" not in run(shorter)


@pytest.mark.parametrize(
    ("part", "stuck", "problem"),
    [
        # Placeholders, and lost tracking.
        (slice(40, None, 50), False, "the poses jump (steps: "),
        (slice(200, 400), True, "of the events fall between poses that are equal (the first at 800000000 ns)"),
    ],
)
def test_wrong_poses_in_places_are_no_wrong_axes(part: slice, stuck: bool, problem: str, shorter: Path) -> None:
    def change(poses: torch.Tensor) -> torch.Tensor:
        poses = poses.clone()
        poses[part] = poses[part.start] if stuck else torch.eye(4, dtype=poses.dtype)
        return poses

    change_poses(shorter, change)
    output = run(shorter, status=1)
    assert problem in output
    assert "as if" not in output.split("problem")[-1]
    assert "the contrast does not tell whether poses, lens and clock are right" in output


@pytest.mark.parametrize(
    ("changes", "problems"),
    [
        (
            {"width": 128, "height": 96, "cx": 64.0, "cy": 48.0},
            ["all events lie in the first 64 x 48 of 128 x 96 pixels"],
        ),
        ({"cx": 320.0, "cy": 240.0}, ["the principal point (320, 240) is far from the middle of 64 x 48 pixels"]),
        (
            {"cx": 24.0, "cy": 32.0, "fl_x": 4.0, "fl_y": 4.0},
            ["the principal point (24, 32) seems to have x and y swapped", "a focal length of 4 pixels is 0.062 times"],
        ),
    ],
)
def test_a_lens_of_another_size_is_no_wrong_axes(changes: dict, problems: list[str], shorter: Path) -> None:
    edit_json("transforms.json", lambda meta: meta["event_camera"].update(changes))(shorter)
    output = run(shorter, status=1)
    assert all(problem in output for problem in problems)
    assert "as if" not in output.split("problem")[-1]


def test_a_part_of_the_sensor_may_have_its_principal_point_anywhere(shorter: Path, tmp_path: Path) -> None:
    Convert(shorter, tmp_path / "part", region=(0, 0, 64, 24)).main()
    output = run(tmp_path / "part", status=0)
    assert "principal point" not in output
    assert "--pipeline.model.near-plane" in output


def test_a_lens_that_ends_before_the_events_is_named(shorter: Path) -> None:
    events = all_events(read_native(shorter))
    rewrite(shorter, events[events.x < 12])
    edit_json("transforms.json", lambda meta: meta["event_camera"].update(k1=-20.0))(shorter)
    output = run(shorter, status=1)
    assert "the lens gives no direction to the pixels of nearly all events" in output


def test_one_slice_gives_no_verdict(room: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(room, tmp_path / "room")
    rewrite(folder, all_events(read_native(folder))[:3500])
    change_poses(folder, lambda poses: poses @ OPENCV_TO_OPENGL)
    set_in("transforms.json", "scene_box", value=[[-0.5] * 3, [0.5] * 3])(folder)
    output = run(folder)
    assert "as if" not in output.split("problem")[-1]
    assert "the scene box holds only" not in output
    assert "Within the scene box: " in output
    assert "Because of too few events, the contrast does not tell" in output


@pytest.mark.parametrize(
    ("in_favor", "problem"),
    # Of five slices three say nothing of the clock, and four name it. Four that fit different ones tell of other poses.
    [([{0, 1, 2}], None), ([{0, 1, 2, 3}], "the clock of the poses is"), ([{0, 1}, {2, 3}], "another meaning of the")],
)
def test_a_clock_is_named_where_four_slices_fit_it(in_favor: list[set[int]], problem: str | None) -> None:
    clocks = [
        SimpleNamespace(
            hypothesis=clock_hypothesis(20_000_000 * index), contrast=0.9, given=0.5, slices_in_favor=frozenset(slices),
            is_clearly_better=True, is_clearly_worse=False, is_inconclusive=False, is_like=lambda other: False,
        )
        for index, slices in enumerate(in_favor, 1)
    ]  # fmt: skip
    warped = SimpleNamespace(
        spans=[(0, 10**8)] * 5,
        compare=lambda still: SimpleNamespace(given=0.5, contrast=0.2, is_clearly_worse=True),
        compare_alternatives=lambda: clocks,
        shuffled_contrasts=lambda: np.array([0.1, 0.1]),
    )
    result = SimpleNamespace(figures=[], problems=[])
    assert check_contrast(result, warped, is_simple=False) == (problem is None)
    assert [problem in found for found in result.problems] == [True] * (problem is not None)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-6])
def test_a_scene_of_another_unit_is_a_problem(scale: float) -> None:
    tile = SimpleNamespace(
        energy=np.ones(1), brightness=np.ones(1), depth=np.array([1950.0]), points=np.array([[0.0, 0.0, 1950.0]])
    )
    result = SimpleNamespace(figures=[], problems=[])
    check_depth(result, SimpleNamespace(given=[tile, tile]), SimpleNamespace(scene_box=None), scale)
    named = [f"is {1950 * scale:.2g} scene units away", "--auto-scale-poses False --scale-factor 0.0005,"]
    assert [all(words in found for words in named) for found in result.problems] == [True] * (scale != 1e-3)
