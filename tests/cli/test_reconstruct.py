"""``aenerf reconstruct``: a dataset of reconstructed images, which this project and Nerfstudio read."""

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from helpers.dataset_faults import MOUNTED_APART, OTHER_LENS, Change, set_in
from helpers.small_datasets import AS_RECORDED, START, parse, read_native, write_native
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.cli.reconstruct import Reconstruct
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.reconstruction.networks import E2VID, FireNet


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = write_native(tmp_path / "made", np.array([[-1.0, -2.0, 0.0], [3.0, 4.0, 5.0]]))
    estimated = perturb(read_tum_trajectory(folder / "trajectory_ground_truth.txt"), 1.0, 0.02, 0.2, 0)
    write_tum_trajectory(folder / "trajectory_estimated.txt", estimated)
    return folder


def test_images_have_poses_of_their_times(data: Path, tmp_path: Path) -> None:
    Reconstruct(data, tmp_path / "out").main()
    before, after = read_native(data), read_native(tmp_path / "out")
    # 200 events in batches of int(0.35 * 6 * 4).
    views = after.reference_views["train"]
    assert len(views) == 25
    (events,) = before.event_file.chunks()
    # A tenth of an event per pixel ahead of the end of the batch, and what the sensor lags.
    assert before.sensor.image_lag > 10**5
    assert [view.time for view in views] == (events.t[5::8] - before.sensor.image_lag).tolist()
    for view in views:
        pose = homogeneous(before.reference_trajectory.interpolate(view.time))
        torch.testing.assert_close(view.camera_to_world, pose, rtol=0, atol=1e-9)
        with Image.open(view.file) as image:
            assert (image.size, image.mode) == ((6, 4), "RGB")
    assert len({view.file.read_bytes() for view in views}) == 25
    # All else is that of the recording.
    (copied,) = after.event_file.chunks()
    for name in "xytp":
        np.testing.assert_array_equal(getattr(copied, name), getattr(events, name))
    assert after.ground_truth is not None
    assert torch.equal(after.trajectory.times, before.trajectory.times)
    assert (after.event_camera, after.sensor) == (before.event_camera, before.sensor)
    assert after.scene_box is not None
    for split in ("val", "test"):
        for one, other in zip(before.reference_views[split], after.reference_views[split], strict=True):
            assert one.file.read_bytes() == other.file.read_bytes()
            assert torch.equal(one.camera_to_world, other.camera_to_world)
    assert not list(tmp_path.glob(".*"))
    # Nerfstudio reads the folder.
    config = NerfstudioDataParserConfig(data=tmp_path / "out", **AS_RECORDED)
    for split, count in (("train", 25), ("val", 1), ("test", 2)):
        outputs = parse(config, split)
        views = after.reference_views[split]
        assert [Path(name) for name in outputs.image_filenames] == [view.file for view in views]
        assert len(outputs.cameras) == count
        for pose, view in zip(outputs.cameras.camera_to_worlds, views, strict=True):
            expected = (view.camera_to_world @ OPENCV_TO_OPENGL)[:3].float()
            torch.testing.assert_close(pose, expected, rtol=0, atol=1e-6)
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "out" / "reconstruction.mp4"))
    assert next(frames)["size"] == (6, 4)
    assert len(list(frames)) == 25


@pytest.mark.parametrize("network", [E2VID, FireNet])
def test_network_reconstructs_with_given_weights(
    network: type[E2VID] | type[FireNet], data: Path, tmp_path: Path
) -> None:
    made = network()
    state = torch.nn.ModuleDict({made.name_in_file: made}).state_dict()
    torch.save({"state_dict": state}, tmp_path / "weights.pth.tar")
    Reconstruct(data, tmp_path / "out", tmp_path / "weights.pth.tar", events_per_pixel=2.0).main()
    assert len(read_native(tmp_path / "out").reference_views["train"]) == 4


@pytest.mark.parametrize("is_scaled", [False, True])
def test_poses_keep_their_scale(is_scaled: bool, native: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    set_in("transforms.json", "auto_scale_poses", value=is_scaled)(native)
    Reconstruct(native, tmp_path / "my images").main()
    after = NativeDataParserConfig(data=tmp_path / "my images").setup()
    assert after.scales_poses(after.recording) is is_scaled
    assert f"ns-train e2vid-nerf --data '{tmp_path}/my images'\n" in capsys.readouterr().out


def test_images_without_a_pose_are_left_out(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    poses = read_tum_trajectory(data / "trajectory_estimated.txt")
    write_tum_trajectory(data / "trajectory_estimated.txt", poses.crop(START, START + 500_000_000))
    Reconstruct(data, tmp_path / "out").main()
    views = read_native(tmp_path / "out").reference_views["train"]
    assert 0 < len(views) < 25
    assert all(view.time is not None and view.time <= START + 500_000_000 for view in views)
    assert f"{25 - len(views)} of 25 images are left out" in capsys.readouterr().out


def test_images_in_a_gap_of_the_true_poses_are_left_out(data: Path, tmp_path: Path) -> None:
    lines = (data / "trajectory_ground_truth.txt").read_text().splitlines()
    (data / "trajectory_ground_truth.txt").write_text("\n".join(lines[:5] + lines[14:]))
    gap = [START + int(1e9 * (float(line.split()[0]) - float(lines[-21].split()[0]))) for line in (lines[4], lines[14])]
    Reconstruct(data, tmp_path / "out").main()
    views = read_native(tmp_path / "out").reference_views["train"]
    assert len(views) > 5
    assert not any(view.time is not None and gap[0] + 1e6 < view.time < gap[1] - 1e6 for view in views)


@pytest.mark.parametrize("change", [OTHER_LENS, MOUNTED_APART])
def test_images_of_another_camera_are_left_out(
    change: Change, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    change(data)
    Reconstruct(data, tmp_path / "out").main()
    views = read_native(tmp_path / "out").reference_views
    assert [len(views[split]) for split in ("train", "val", "test")] == [25, 0, 0]
    assert "of another camera" in capsys.readouterr().out


def test_faults_leave_nothing(data: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="make 0 images of 216 events each"):
        Reconstruct(data, tmp_path / "out", events_per_pixel=9.0).main()
    assert {path.name for path in tmp_path.iterdir()} == {"made"}
