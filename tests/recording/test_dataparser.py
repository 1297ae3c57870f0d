"""Handing a recording to Nerfstudio: time window, world, cameras and images."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers.dataset_faults import set_in
from helpers.published_datasets import DURATION, EPOCH, config_of, seconds, write_images, write_own
from helpers.small_datasets import END, START, make_trajectory, parse, write_native
from helpers.streams import unpacked

from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.dataset import views_to_copy
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.files.event_hdf5 import Hdf5EventFile
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.recording.dataparser import EventDataParser
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.scene import SCENE_KEY


def test_all_splits_share_the_reported_world(native: Path) -> None:
    config = NativeDataParserConfig(data=native)
    train, test = parse(config), parse(config, "test")
    assert train.dataparser_scale == test.dataparser_scale
    assert torch.equal(train.dataparser_transform, test.dataparser_transform)
    original = train.transform_poses_to_original_space(test.cameras.camera_to_worlds, "opencv")
    torch.testing.assert_close(original, make_trajectory().camera_to_worlds[[4, 5]].float(), rtol=0, atol=1e-5)
    # The framework's convention: cameras fit in a box of +/- 1 about the origin.
    positions = train.metadata[SCENE_KEY].trajectory.camera_to_worlds[:, :, 3]
    assert positions.abs().max().item() == pytest.approx(1.0, rel=1e-2)


def test_a_world_far_from_its_origin_is_the_same_scene(tmp_path: Path) -> None:
    near, far = write_native(tmp_path / "near"), write_native(tmp_path / "far")
    offset = torch.tensor([4e5, 5e6, 100.0], dtype=torch.float64)
    path = far / "trajectory_estimated.txt"
    moved = read_tum_trajectory(path).transform(lambda poses: poses + F.pad(offset[:, None], (3, 0, 0, 1)))
    write_tum_trajectory(path, moved)
    first, second = (parse(NativeDataParserConfig(data=data)).metadata[SCENE_KEY] for data in (near, far))
    assert second.scale == pytest.approx(first.scale, rel=1e-6)
    poses = [scene.trajectory.camera_to_worlds for scene in (first, second)]
    torch.testing.assert_close(poses[1], poses[0], rtol=0, atol=1e-6)


def test_scene_box_sets_scale_and_bounds(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made", np.array([[-1.0, -2.0, 0.0], [3.0, 4.0, 1.0]]))
    outputs = parse(NativeDataParserConfig(data=folder))
    assert outputs.metadata[SCENE_KEY].bounded
    torch.testing.assert_close(outputs.scene_box.aabb, torch.tensor([[-2 / 3, -1, -1 / 6], [2 / 3, 1, 1 / 6]]))
    first = outputs.metadata[SCENE_KEY].trajectory.camera_to_worlds[0, :, 3]
    torch.testing.assert_close(first, torch.tensor([-1.0, -1.0, 1.5], dtype=torch.float64) / 3)


def test_training_cameras_show_images_or_events(native: Path) -> None:
    dataset = EventDataset(parse(NativeDataParserConfig(data=native)))
    has_image = dataset.scene.has_image
    # The 21 knots, two of them image times, and one image between two knots.
    assert len(dataset) == 22
    assert [i for i, image in enumerate(has_image) if image] == [0, 2, 21]
    assert (dataset.get_numpy_image(2) == 77).all()
    picture = dataset.get_numpy_image(10)
    assert picture.shape == (4, 6, 3)
    assert (picture.max(-1) != picture.min(-1)).any()


def test_time_window_leaves_out_the_rest(native: Path) -> None:
    start, end = START + 500_000_000, START + 1_050_000_000
    dataset = EventDataset(parse(NativeDataParserConfig(data=native, start_time_ns=start, end_time_ns=end)))
    trajectory = dataset.scene.trajectory
    assert (trajectory.start, trajectory.end) == (start, START + 1_100_000_000)
    assert not any(dataset.scene.has_image)
    intervals = [pair[2:4] for pair in unpacked(dataset.pairs)]
    assert min(begin for begin, _ in intervals) >= start
    assert max(last for _, last in intervals) <= end
    assert dataset.pairs.num_outside > 0
    # The window is cut to the poses.
    config = NativeDataParserConfig(data=native, start_time_ns=0, end_time_ns=END + 10**12)
    assert parse(config).metadata[SCENE_KEY].window == TimeWindow(START, END)
    with pytest.raises(DataError, match="nothing is left from 9 to 9 ns"):
        parse(NativeDataParserConfig(data=native, start_time_ns=9, end_time_ns=9))
    with h5py.File(native / "events.h5", "a") as file:
        file["events/t"][:] = START
    with pytest.raises(DataError, match=f"all its events are at {START} ns; check the unit of the times"):
        parse(NativeDataParserConfig(data=native))


def test_refuse_reference_views_far_away(native: Path) -> None:
    # True poses in a geodetic frame: single precision, which the framework's cameras have, would displace them.
    truth = make_trajectory()
    far = Trajectory(truth.times, truth.camera_to_worlds + torch.tensor([[0, 0, 0, 4e5]], dtype=torch.float64))
    write_tum_trajectory(native / "trajectory_ground_truth.txt", far)
    for index in range(6):
        set_in("transforms.json", "frames", index, "transform_matrix", 0, 3, value=4e5)(native)
    config = NativeDataParserConfig(data=native)
    assert len(parse(config, "train").image_filenames)
    message = r"ground_truth.txt: a reference view is .* times as far .*; subtract one offset"
    with pytest.raises(DataError, match=message):
        parse(config, "test")


def test_refuse_scale_of_turning_camera(ecd: Path) -> None:
    (ecd / "groundtruth.txt").write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n")
    parse(EcdDataParserConfig(data=ecd))
    with pytest.raises(DataError, match="--auto-scale-poses False"):
        parse(EcdDataParserConfig(data=ecd, auto_scale_poses=True))
    # A camera that moves along its axis has no focus.
    (ecd / "groundtruth.txt").write_text("".join(f"{0.1 * i} 0 0 {i} 0 0 0 1\n" for i in range(5)))
    with pytest.raises(DataError, match=r"groundtruth.txt: all cameras look in one direction and have no focus; give"):
        parse(EcdDataParserConfig(data=ecd, center_method="focus"))


def test_images_are_thinned_within_the_window(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    write_images(truth.data / "images", 200, (60, 40))
    start, length = EPOCH * 1_000, DURATION * 1_000
    stamps = seconds(start + np.linspace(0, length, 200).astype(np.int64))
    lines = [f"{stamp} images/{index:05d}.png\n" for index, stamp in enumerate(stamps)]
    (truth.data / "images.txt").write_text("".join(lines))
    config = config_of("event-recording-data", truth.data)
    assert [len(parse(config, split).image_filenames) for split in ("val", "test")] == [30, 30]
    # A tenth of the time, and all of its images.
    window = {"start_time_ns": start + length // 2, "end_time_ns": start + length * 6 // 10}
    windowed = config_of("event-recording-data", truth.data, **window)
    assert [len(parse(windowed, split).image_filenames) for split in ("val", "test")] == [10, 10]
    # Poses are estimated from all of them, also where there are none yet.
    assert len(config.setup().read_frames()[1]) == 200
    # A dataset that is converted has all frames that may be trained on.
    views = views_to_copy(config.setup().recording, TimeWindow())
    assert {split: len(kept) for split, kept in views.items()} == {"train": 200, "val": 30, "test": 30}
    poses = truth.data / "trajectory.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:-5]))
    assert len(config.setup().read_frames()[1]) == 200
    assert len(config.setup().recording.reference_views["train"]) < 200
    (truth.data / "trajectory.txt").unlink()
    capture, images = config.setup().read_frames()
    assert len(images) == 200
    assert not isinstance(capture, Recording)


@pytest.mark.parametrize(
    ("option", "value"), [("max_pose_gap_ns", 0), *(("scale_factor", value) for value in (0.0, -1.0, np.nan, np.inf))]
)
def test_refuse_what_is_not_positive(option: str, value: float, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"--{option.replace('_', '-')} is {value}; give a positive number"):
        config_of("event-recording-data", tmp_path, **{option: value}).setup()


@pytest.mark.parametrize("option", ["start_time_ns", "end_time_ns", "max_pose_gap_ns", "refractory_period_ns"])
@pytest.mark.parametrize("value", [10**19, -(10**400)])
def test_refuse_times_beyond_64_bits(option: str, value: int, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"--{option.replace('_', '-')} is -?1000.*; give nanoseconds"):
        config_of("event-recording-data", tmp_path, **{option: value}).setup()


def test_windows_read_the_events_once(
    native: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    start, end = START + 500_000_000, START + 1_050_000_000
    outputs = parse(NativeDataParserConfig(data=native, start_time_ns=start, end_time_ns=end))
    reads = []
    original = Hdf5EventFile.read_chunks
    monkeypatch.setattr(Hdf5EventFile, "read_chunks", lambda file: reads.append(file) or original(file))
    dataset = EventDataset(outputs)
    windows = dataset.windows
    with h5py.File(native / "events.h5") as file:
        times = file["events/t"][()]
    inside = (times > start) & (times <= end)
    assert windows.counts(start, end).sum() == inside.sum() > 20
    assert windows.pieces == ((start, end),)
    assert "events.h5: 200 events," in capsys.readouterr().out
    # The pictures of the cameras are of these events, which are not read again as pairs.
    assert dataset.get_numpy_image(1).std() > 0
    assert len(reads) == 1


def test_a_format_that_cannot_do_without_poses_says_which_are_missing(native: Path) -> None:
    class Parser(EventDataParser):
        def poses_path(self) -> Path:
            return self.data / "poses.txt"

        def read_recording(self) -> Recording:
            raise AssertionError(read_tum_trajectory(self.poses_path()))

    with pytest.raises(DataError, match=r"poses.txt: there is no such file"):
        Parser(NativeDataParserConfig(data=native)).read_frames()
