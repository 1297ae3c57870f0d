"""The text format of the Event Camera Dataset."""

from pathlib import Path

import pytest
import torch
from helpers.small_datasets import parse
from helpers.streams import unpacked

from aenerf_ns.camera.metadata_keys import REFERENCE_SECONDS
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.dataparsers.ecd import EcdDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY


def test_guessed_size_can_be_given(ecd: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (ecd / "images.txt").unlink()
    (ecd / "events.txt").write_text("0.01 300 2 1\n0.02 300 2 0\n0.31 1 2 1\n")
    config = EcdDataParserConfig(data=ecd, width=346, height=260)
    assert len(next(config.setup().recording.event_file.chunks())) == 3
    for given in ({}, {"width": 346}):
        recording = EcdDataParserConfig(data=ecd, **given).setup().recording
        assert (recording.event_camera.width, recording.event_camera.height) == (given.get("width", 240), 180)
    assert "size 346 x 180 is a guess: if it is another" in capsys.readouterr().out
    with pytest.raises(DataError, match=r"line 1 has x = 300; .* check the sensor size"):
        list(EcdDataParserConfig(data=ecd).setup().recording.event_file.chunks())
    with pytest.raises(DataError, match=r"made: width must be .*, not 0; correct --width or --height"):
        _ = EcdDataParserConfig(data=ecd, width=0).setup().recording


def test_ecd_text_reads(ecd: Path) -> None:
    config = EcdDataParserConfig(data=ecd)
    dataset = EventDataset(parse(config))
    camera = dataset.scene.event_camera
    # The format counts the principal point from the center of the first pixel.
    assert (camera.width, camera.height, camera.cx, camera.cy) == (6, 4, 3.0, 2.0)
    (chunk,) = dataset.scene.event_file.chunks()
    assert chunk.t.tolist() == [10_000_000, 20_000_000, 30_000_000, 310_000_000]
    assert chunk.p.tolist() == [1, -1, 1, 1]
    assert dataset.scene.window == TimeWindow(10_000_000, 310_000_000)
    assert [pair[3] for pair in unpacked(dataset.pairs)] == [20_000_000, 310_000_000]
    # Images at 0.05 and 0.25 s validate, 0.15 s tests, 0.35 s is after the last event.
    assert len(parse(config, "val").image_filenames) == 2
    assert len(parse(config, "test").image_filenames) == 1


def test_an_image_in_a_gap_of_the_true_poses_is_left_out(ecd: Path, tmp_path: Path) -> None:
    (ecd / "groundtruth.txt").rename(tmp_path / "other.txt")
    times = [0.01 * i for i in range(41) if not 10 < i < 30]
    (ecd / "groundtruth.txt").write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in times))
    for trajectory in (None, tmp_path / "other.txt"):
        views = EcdDataParserConfig(data=ecd, trajectory=trajectory).setup().recording.reference_views["train"]
        assert [view.file.name for view in views] == ["0.png", "3.png"]


def test_names_of_images_hold_a_blank(ecd: Path) -> None:
    config = EcdDataParserConfig(data=ecd)
    names = [name for _, name in (line.split() for line in (ecd / "images.txt").read_text().splitlines())]
    files = [f"view {k}.png" for k in range(len(names))]
    for name, file in zip(names, files, strict=True):
        (ecd / name).rename(ecd / file)
    lines = [f"0.{k}5,{file}  # a view" for k, file in enumerate(files)]
    (ecd / "images.txt").write_text("# t,file\n" + "\n".join(lines))
    assert [path.name for _, path in config.setup().read_capture()[1]] == files


def test_ecd_text_may_be_given_other_poses(ecd: Path, tmp_path: Path) -> None:
    truth = read_tum_trajectory(ecd / "groundtruth.txt")
    other = perturb(truth, rotation_degrees=2.0, translation=0.1, correlation_time=0.1, seed=0)
    write_tum_trajectory(tmp_path / "other.txt", other)
    config = EcdDataParserConfig(data=ecd, trajectory=tmp_path / "other.txt")
    outputs, as_given = parse(config), parse(EcdDataParserConfig(data=ecd))
    scene = outputs.metadata[SCENE_KEY]
    assert as_given.metadata[SCENE_KEY].ground_truth is None
    # In the scene's frame, which follows from the estimated poses; images have true ones.
    to_scene = homogeneous(outputs.dataparser_transform.double())
    for name, poses in (("ground_truth", truth), ("trajectory", other)):
        times = getattr(scene, name).times
        expected = to_scene @ homogeneous(poses.interpolate(times)) @ OPENCV_TO_OPENGL
        torch.testing.assert_close(getattr(scene, name).camera_to_worlds, expected[:, :3], rtol=0, atol=1e-6)
    views = parse(config, "test").cameras
    expected = to_scene @ homogeneous(truth.interpolate([150_000_000])) @ OPENCV_TO_OPENGL
    torch.testing.assert_close(views.camera_to_worlds, expected[:, :3].float(), rtol=0, atol=1e-6)
    assert views.metadata is not None
    taken = views.metadata[REFERENCE_SECONDS][0, 0].item()
    assert taken == pytest.approx(0.15 - 1e-9 * scene.trajectory.start)
    (ecd / "groundtruth.txt").unlink()
    for read in (parse, lambda config: config.setup().read_frames()):
        with pytest.raises(DataError, match="there are no such poses, which --trajectory needs as the true ones; give"):
            read(config)


def test_read_the_real_recording(slider_depth: Path) -> None:
    config = EcdDataParserConfig(data=slider_depth)
    dataset = EventDataset(parse(config))
    pairs = dataset.pairs
    assert pairs.num_events == 50_000
    # The first pose is at 0.0223 s, the events begin at 0.0038 s.
    assert dataset.scene.window == TimeWindow(22_291_582, 174_156_000)
    assert pairs.num_outside == 3_251
    assert len(pairs) + pairs.num_first + pairs.num_outside + pairs.num_merged == 50_000
    assert len(parse(config, "test").image_filenames) == 2
    # A linear slider: straight on, no turn.
    poses = dataset.scene.trajectory.camera_to_worlds
    assert (poses[:, :, :3] - poses[:1, :, :3]).abs().max() < 1e-6
    assert torch.linalg.matrix_rank(poses[1:, :, 3] - poses[0, :, 3], atol=1e-4) == 1
