"""Converting to the native format: only what the options ask for changes, and nothing is left half-written."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.colmap_stand_in import FOUND_BOX, place_frames
from helpers.dataset_faults import MOUNTED_APART, OTHER_LENS, Change
from helpers.event_file_checks import read
from helpers.own_recordings import random_events, write_calibration, write_poses
from helpers.small_datasets import END, START, make_trajectory, read_native, write_ecd, write_native
from helpers.streams import random_stream
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.convert import Convert
from aenerf_ns.cli.reconstruct import Reconstruct
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.files.event_hdf5 import Hdf5EventWriter
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.pose_estimation import from_frames
from aenerf_ns.pose_estimation.placement import EstimatedPoses
from aenerf_ns.recording.recording import Capture, Recording
from aenerf_ns.recording.writer import NativeDatasetWriter


def convert(data: Path, output: Path, **options: object) -> Recording:
    Convert(data, output, **options).main()
    return read_native(output)


def assert_same(one: Recording, other: Recording) -> None:
    """Assert that events, poses, lenses, sensor and images are the same."""
    np.testing.assert_array_equal(read(one.event_file), read(other.event_file))
    for name in ("trajectory", "ground_truth"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None)
        if a is not None:
            assert torch.equal(a.times, b.times)
            torch.testing.assert_close(a.camera_to_worlds, b.camera_to_worlds, rtol=0, atol=1e-9)
    assert one.event_camera == other.event_camera
    assert one.frame_camera == other.frame_camera
    assert one.sensor == other.sensor
    assert one.image_encoding == other.image_encoding
    assert one.has_assumed_thresholds == other.has_assumed_thresholds
    for split, views in one.reference_views.items():
        assert len(views) == len(other.reference_views[split])
        for a, b in zip(views, other.reference_views[split], strict=True):
            assert a.file.read_bytes() == b.file.read_bytes()
            assert a.time == b.time
            torch.testing.assert_close(a.camera_to_world, b.camera_to_world, rtol=0, atol=1e-9)


@pytest.mark.parametrize("box", [None, np.array([[-1.0, -2.0, 0.0], [3.0, 4.0, 5.0]])])
def test_native_dataset_converts_to_itself(box: np.ndarray | None, tmp_path: Path) -> None:
    data = write_native(tmp_path / "made", box)
    noisy = perturb(make_trajectory(), 1.0, 0.02, 0.2, 0)
    write_tum_trajectory(data / "trajectory_estimated.txt", noisy)
    after = convert(data, tmp_path / "converted")
    assert_same(read_native(data), after)
    assert (box is None) == (after.scene_box is None)
    if box is not None and after.scene_box is not None:
        np.testing.assert_array_equal(after.scene_box.numpy(), box)


def test_text_files_convert(ecd: Path, tmp_path: Path) -> None:
    given = tmp_path / "other.txt"
    write_tum_trajectory(given, perturb(read_tum_trajectory(ecd / "groundtruth.txt"), 2.0, 0.1, 0.1, 0))
    for name, options in (("plain", ()), ("other", (f"trajectory={given}",))):
        with CONSOLE.capture() as output:
            after = convert(ecd, tmp_path / name, format="ecd-data", format_options=options)
        assert "4 of 4 events, 5 poses, images: 4 train, 2 val, 2 test." in output.get()
        config = EcdDataParserConfig(data=ecd, trajectory=given if options else None)
        assert_same(config.setup().read_recording(), after)
        # An image of several splits is written once.
        assert len(list((tmp_path / name / "images").rglob("*.png"))) == 4
    assert not list(tmp_path.glob(".*"))


def test_a_file_at_two_times_is_two_images(ecd: Path, tmp_path: Path) -> None:
    (ecd / "images.txt").write_text("0.05 images/0.png\n0.15 images/0.png\n")
    assert_same(EcdDataParserConfig(data=ecd).setup().read_recording(), convert(ecd, tmp_path / "converted"))


def test_frame_camera_and_images_are_carried_over(native: Path, tmp_path: Path) -> None:
    meta = json.loads((native / "transforms.json").read_text())
    meta.update(w=8, h=5, fl_x=9.0, fl_y=9.5, cx=4.1, cy=2.4, camera_model="OPENCV_FISHEYE", k1=0.1, k4=-0.2)
    # Other programs' names that say nothing else.
    meta.update(is_fisheye=True, fisheye_crop_radius=3, undistorted=True)
    for key in ("k2", "k3", "p1", "p2"):
        meta.pop(key)
    for index, frame in enumerate(meta["frames"]):
        (native / frame["file_path"]).unlink()
        old, new = frame["file_path"], f"images/{index}.jpg"
        Image.fromarray(np.full((5, 8), 30 * index, np.uint8)).save(native / new)
        for split in ("train", "val", "test"):
            meta[f"{split}_filenames"] = [new if name == old else name for name in meta[f"{split}_filenames"]]
        frame["file_path"] = new
    (native / "transforms.json").write_text(json.dumps(meta))
    before = read_native(native)
    assert before.frame_camera.lens_model == "fisheye"
    assert_same(before, convert(native, tmp_path / "converted"))


def test_alpha_is_composed_with_the_background(native: Path, tmp_path: Path) -> None:
    recording = read_native(native)
    pixels = np.zeros((4, 6, 4), np.uint8)
    pixels[:, 3:] = (255, 0, 0, 255)
    pixels[0, 0] = (0, 0, 0, 51)
    Image.fromarray(pixels).save(tmp_path / "alpha.png")
    camera, trajectory = recording.event_camera, recording.trajectory
    with NativeDatasetWriter(tmp_path / "out", camera, recording.sensor, "linear") as writer:
        writer.add_trajectories(trajectory)
        pose = torch.eye(4, dtype=torch.float64)
        for split in ("val", "test"):
            writer.add_image_file(split, tmp_path / "alpha.png", pose, background=(1.0, 0.5, 1.0))
    (file,) = (tmp_path / "out" / "images").rglob("*.png")
    written = np.asarray(Image.open(file))
    assert written.shape == (4, 6, 3)
    assert written[1, 1].tolist() == [255, 128, 255]
    assert written[1, 4].tolist() == [255, 0, 0]
    assert written[0, 0].tolist() == [204, 102, 204]


def test_filters_cut_everything(native: Path, tmp_path: Path) -> None:
    before = read_native(native)
    start, end = START + 100_000_000, START + 1_450_000_000
    options = {"start_time_ns": start, "end_time_ns": end, "region": (2, 0, 3, 2), "pixel_share": 0.5, "seed": 3}
    after = convert(native, tmp_path / "converted", **options)
    events = read(before.event_file)
    x, y, t, _ = events.T
    inside = (t >= start) & (t <= end) & (x >= 2) & (x < 5) & (y < 2)
    found = {*map(tuple, read(after.event_file).tolist())}
    expected = {*map(tuple, (events[inside] - [2, 0, 0, 0]).tolist())}
    assert found < expected
    pixels = {row[:2] for row in found}
    assert found == {row for row in expected if row[:2] in pixels}
    assert after.event_camera == before.event_camera.crop(2, 0, 3, 2)
    assert after.frame_camera == before.frame_camera
    assert (after.trajectory.start, after.trajectory.end) == (start, START + 1_500_000_000)
    # One of three train images is within the window. Images without a time are kept.
    assert [len(after.reference_views[split]) for split in ("train", "val", "test")] == [1, 1, 2]


def test_images_outside_the_events_take_no_places(tmp_path: Path) -> None:
    # 100 images in 50 s, and events in the first of them only.
    folder = tmp_path / "made"
    (folder / "images").mkdir(parents=True)
    for index in range(100):
        Image.new("L", (96, 72)).save(folder / "images" / f"{index}.png")
    (folder / "images.txt").write_text("".join(f"{index / 2 + 0.25} images/{index}.png\n" for index in range(100)))
    np.savez(folder / "events.npz", **random_events(seconds=1.0))
    write_calibration(folder / "calibration.json")
    write_poses(folder / "trajectory.txt", seconds=50.0)
    Reconstruct(folder, tmp_path / "reconstructed", events_per_pixel=0.1).main()
    for after in (convert(folder, tmp_path / "converted"), convert(tmp_path / "reconstructed", tmp_path / "again")):
        assert [len(after.reference_views[split]) for split in ("val", "test")] == [1, 1]


def test_hot_pixels_are_named(native: Path, tmp_path: Path) -> None:
    events = random_stream(3000, 6, 4, END, start=START, seed=1)
    events.x[::2], events.y[::2] = 3, 1
    with Hdf5EventWriter(native / "events.h5") as writer:
        writer.append(events)
    with CONSOLE.capture() as output:
        after = convert(native, tmp_path / "converted", drop_hot_pixels=True)
    assert "Hot pixels: 1, with 5" in output.get()
    assert "(3, 1) 1,5" in output.get()
    hot = (events.x == 3) & (events.y == 1)
    np.testing.assert_array_equal(read(after.event_file)[:, 2], events.t[~hot])


def test_poses_from_frames_replace_the_given_ones(ecd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place_frames(3, monkeypatch)
    with CONSOLE.capture() as output:
        with_truth = convert(ecd, tmp_path / "with_truth", poses="colmap")
    assert "z is up if the camera was held level, and the scale is arbitrary" in " ".join(output.get().split())
    assert "3 of 4 frames registered" in output.get()
    assert "Compared with the given poses, which are kept as ground truth: " in output.get()
    with CONSOLE.capture() as output:
        convert(tmp_path / "with_truth", tmp_path / "again", poses="colmap")
    assert "Compared with the ground truth: " in output.get()
    times = [50_000_000, 150_000_000, 250_000_000]
    assert with_truth.trajectory.times.tolist() == times
    truth = read_tum_trajectory(ecd / "groundtruth.txt")
    assert with_truth.ground_truth is not None
    torch.testing.assert_close(with_truth.ground_truth.camera_to_worlds, truth.camera_to_worlds)
    report = json.loads((tmp_path / "with_truth" / "poses_report.json").read_text())
    assert report["registered_frames"] == 3
    # Both trajectories are straight, at constant speed.
    assert report["errors"]["translation_error"] < 1e-9
    np.testing.assert_array_equal(with_truth.scene_box, FOUND_BOX)
    # All images are kept, with the true poses.
    assert [len(with_truth.reference_views[split]) for split in ("train", "val", "test")] == [4, 2, 2]
    (ecd / "groundtruth.txt").unlink()
    without = convert(ecd, tmp_path / "without", poses="colmap", format="ecd-data")
    assert without.ground_truth is None
    assert without.trajectory.times.tolist() == times
    assert [len(without.reference_views[split]) for split in ("train", "val", "test")] == [3, 2, 1]
    np.testing.assert_array_equal(read(without.event_file), read(with_truth.event_file))
    with pytest.raises(DataError, match=r"groundtruth.txt: there are no such poses"):
        convert(ecd, tmp_path / "given", format="ecd-data")


def find_three_poses(monkeypatch: pytest.MonkeyPatch, first: int) -> None:
    """Let poses from events be found at three times, from a first one in nanoseconds on."""
    place_frames(3, monkeypatch)

    def estimate(capture: Capture, window: TimeWindow, source: Path, seed: int, *_: object) -> EstimatedPoses:
        times = [first, first + 100_000_000, first + 200_000_000]
        found = from_frames.estimate_poses([source] * 3, times, capture.event_camera, source, seed)
        # Two images in a row are lost, where one may be.
        lost = [times[1] + 10_000_000, times[1] + 20_000_000]
        return replace(found, frame_times=np.array([*times[:2], *lost, times[2]]), max_lost=1)

    monkeypatch.setattr("aenerf_ns.pose_estimation.from_events.estimate_poses_from_events", estimate)


def test_images_of_another_camera_are_left_out_of_poses_from_events(
    native: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_three_poses(monkeypatch, START)
    MOUNTED_APART(native)
    for name in ("estimated", "ground_truth"):
        (native / f"trajectory_{name}.txt").unlink()
    with CONSOLE.capture() as output:
        found = convert(native, tmp_path / "found", poses="events")
    assert "The recording's images are left out: they are of another camera than the events." in output.get()
    assert not any(found.reference_views.values())
    assert found.frame_from_event is None


def test_given_poses_of_another_time_are_left_out(ecd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find_three_poses(monkeypatch, 50_000_000)
    given = read_tum_trajectory(ecd / "groundtruth.txt")
    write_tum_trajectory(ecd / "groundtruth.txt", Trajectory(given.times + 10**12, given.camera_to_worlds))
    with CONSOLE.capture() as output:
        options = {"format": "ecd-data", "format_options": ("max-pose-gap-ns=150000000",)}
        found = convert(ecd, tmp_path / "found", poses="events", **options)
    assert found.max_pose_gap == 150_000_000
    assert "The given poses, from 1000000000000 to " in output.get()
    assert "are of another time than the estimated ones, from 50000000 to 250000000 ns: they are left" in output.get()
    assert found.ground_truth is None
    assert found.trajectory.times.tolist() == [50_000_000, 150_000_000, 250_000_000]
    assert convert(ecd, tmp_path / "again", poses="events", format="ecd-data").max_pose_gap == 100_000_000


def test_true_poses_of_another_time_are_left_out(native: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find_three_poses(monkeypatch, START)
    truth = read_tum_trajectory(native / "trajectory_ground_truth.txt")
    write_tum_trajectory(truth.source, Trajectory(truth.times + 10**12, truth.camera_to_worlds))
    with CONSOLE.capture() as output:
        assert convert(native, tmp_path / "found", poses="events").ground_truth is None
    assert f"The true poses, from {START + 10**12} to " in output.get()


@pytest.mark.parametrize(
    ("poses", "search"), [("events", "from_events.estimate_poses_from_events"), ("refined", "from_poses.refine_poses")]
)
def test_broken_images_are_refused_before_poses_are_found(
    poses: str, search: str, ecd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"aenerf_ns.pose_estimation.{search}", lambda *_: pytest.fail("it searched"))
    for image in (ecd / "images").iterdir():
        image.write_bytes(b"no image")
    with pytest.raises(DataError, match=r"images/\S+\.png: "):
        convert(ecd, tmp_path / "converted", poses=poses)


@pytest.mark.parametrize(
    ("factor", "shift", "message"),
    [(1000, 0, "as if the times of the images were in millisec"), (1, 1000, "0 of 4 frames were taken during the ev")],
)
def test_frames_on_another_clock_are_refused_before_poses_are_found(
    factor: int, shift: int, message: str, ecd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aenerf_ns.pose_estimation.from_frames.estimate_poses", lambda *_: pytest.fail("it searched"))
    (ecd / "groundtruth.txt").unlink()
    rows = [row.split() for row in (ecd / "images.txt").read_text().splitlines()]
    moved = [f"{factor * float(time) + shift:.9f} {name}" for time, name in rows]
    (ecd / "images.txt").write_text("\n".join(moved))
    with pytest.raises(DataError, match=message):
        convert(ecd, tmp_path / "converted", poses="colmap", format="ecd-data")


def test_the_report_on_poses_stays_with_them(native: Path, tmp_path: Path) -> None:
    (native / "poses_report.json").write_text('{"summary": "Found by hand."}')
    Image.new("RGB", (3, 2)).save(native / "poses_report.png")
    convert(native, tmp_path / "once", pixel_share=0.5)
    convert(tmp_path / "once", tmp_path / "twice")
    for name in ("poses_report.json", "poses_report.png"):
        assert (tmp_path / "twice" / name).read_bytes() == (native / name).read_bytes()


@pytest.mark.parametrize("change", [OTHER_LENS, MOUNTED_APART])
def test_frames_of_another_camera_give_no_poses(change: Change, native: Path, tmp_path: Path) -> None:
    change(native)
    assert not convert(native, tmp_path / "given").has_own_frames
    with pytest.raises(DataError, match="frames are of another camera than its events"):
        convert(native, tmp_path / "converted", poses="colmap")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pixel_share": 0.0}, "aenerf convert: the share of pixels must be above 0"),
        ({"region": (0, 0, 7, 4)}, "region of interest 0 0 7 4 .* beyond its 6 x 4 pixels"),
        ({"region": (1, 0, 4, 4)}, "from pixel 1 0 of a color sensor; begin it at an even"),
        ({"end_time_ns": START - 1}, "events are from .* all outside the time window; widen"),
        ({"start_time_ns": 2**63}, "time window begins at 9223372036854775808 ns, which must fit in 64 bits"),
        ({"start_time_ns": 5, "end_time_ns": 4}, "time window ends at 4 ns, before"),
        ({"end_time_ns": 2**63}, "time window ends at 9223372036854775808 ns, which must fit in 64 bits"),
        ({"pixel_share": float("nan")}, "the share of pixels must be above 0"),
        ({"shortest_interval_ns": -1}, "the shortest interval must be from 0"),
        ({"region": (0, 0, 0, 4)}, "must be x, y, width, height, of positive size"),
        ({"region": (-1, 0, 2, 4)}, "must be x, y, width, height, of positive size"),
        ({"pixel_share": 1e-9}, "no event is left; widen"),
        ({"poses": "events", "region": (0, 0, 7, 4)}, "region of interest 0 0 7 4 .* beyond its 6 x 4 pixels"),
        ({"poses": "refined", "region": (1, 0, 4, 4)}, "from pixel 1 0 of a color sensor; begin it at an even"),
        ({"poses": "colmap", "end_time_ns": START + 1}, "1 frames; poses can be estimated from three"),
        ({"poses": "events", "seed": 2**32}, "--seed: 4294967296 is out of range"),
    ],
)
def test_impossible_options_are_one_line(options: dict, message: str, native: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        convert(native, tmp_path / "converted", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_poses_are_refined_only_where_the_truth_is_of_their_time(native: Path, tmp_path: Path) -> None:
    truth = read_tum_trajectory(native / "trajectory_ground_truth.txt")
    late = Trajectory(truth.times + 10**12, truth.camera_to_worlds)
    write_tum_trajectory(native / "trajectory_ground_truth.txt", late)
    with pytest.raises(DataError, match=r"trajectory_ground_truth\.txt: .* do not cover two of the estimated"):
        convert(native, tmp_path / "converted", poses="refined")


def test_print_the_command_to_train_with(tmp_path: Path) -> None:
    metric, scaled = write_ecd(tmp_path / "metric"), write_native(tmp_path / "scaled")
    for source, scale in ((metric, False), (scaled, True)):
        folder = tmp_path / f"made {source.name}"
        with CONSOLE.capture() as output:
            Convert(source, folder).main()
        advice = f"Look it over with: aenerf check '{folder}'\nTrain with: ns-train aenerf --data '{folder}'"
        assert advice in output.get()
        # The dataset states the scale, so that every command takes the same.
        parser = NativeDataParserConfig(data=folder).setup()
        parser.get_dataparser_outputs("train")
        assert parser.config.auto_scale_poses is scale


def test_terminated_command_leaves_no_dataset(native: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def append(*_: object) -> None:
        assert (tmp_path / ".converted.partial" / "events.h5").exists()
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Hdf5EventWriter, "append", append)
    with pytest.raises(SystemExit) as ended:
        Convert(native, tmp_path / "converted").main()
    assert ended.value.code == 128 + signal.SIGTERM
    assert [path.name for path in tmp_path.iterdir()] == ["made"]
