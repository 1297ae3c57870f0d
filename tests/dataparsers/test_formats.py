"""Every published format is recognized and read exactly, and converts to the native format unchanged."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers.dataset_faults import remove
from helpers.event_file_checks import read
from helpers.published_datasets import WRITERS, Truth, assert_same_poses, config_of, recording_of, seconds, write_poses
from helpers.small_datasets import AS_RECORDED, parse

from aenerf_ns.cli.convert import Convert
from aenerf_ns.dataparsers.formats import FORMATS, AutomaticDataParserConfig, recognize
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.scene import SCENE_KEY
from aenerf_ns.training.datamanager import EventDataManagerConfig


@pytest.fixture(params=WRITERS)
def truth(request: pytest.FixtureRequest, tmp_path: Path) -> Truth:
    """A dataset of every format."""
    return replace(WRITERS[request.param](tmp_path / "made"), format=request.param)


def test_poses_and_events_are_those_written(truth: Truth) -> None:
    recording = recording_of(config_of(truth.format, truth.data))
    np.testing.assert_array_equal(recording.trajectory.times.numpy(), truth.times)
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
    events = np.stack([truth.events[column].astype(np.int64) for column in "xytp"], -1) * [1, 1, 1_000, 1]
    np.testing.assert_array_equal(read(recording.event_file), events)
    assert recording.event_file.time_span() == (truth.events["t"][0] * 1_000, truth.events["t"][-1] * 1_000)


def test_rays_are_those_of_opencv(truth: Truth) -> None:
    camera = recording_of(config_of(truth.format, truth.data)).event_camera
    assert (camera.width, camera.height) == (truth.width, truth.height)
    project = cv2.fisheye.projectPoints if truth.fisheye else cv2.projectPoints
    lens = np.array(truth.distortion or (0.0,) * 4)
    for u, v in ((0, 0), (truth.width // 2, truth.height // 2), (truth.width - 9, truth.height // 3)):
        # A window of the sensor: all of it takes seconds.
        window = replace(camera, width=9, height=7, cx=camera.cx - u, cy=camera.cy - v)
        directions, valid = window.pixel_directions()
        assert valid.all()
        points = (directions * [1, -1, -1]).reshape(-1, 1, 3)
        pixels = project(points, np.zeros(3), np.zeros(3), truth.matrix, lens)[0].reshape(7, 9, 2)
        np.testing.assert_allclose(pixels[..., 0], np.arange(u, u + 9)[None].repeat(7, 0), rtol=0, atol=1e-6)
        np.testing.assert_allclose(pixels[..., 1], np.arange(v, v + 7)[:, None].repeat(9, 1), rtol=0, atol=1e-6)


def test_conversion_to_native_changes_nothing(truth: Truth, tmp_path: Path) -> None:
    Convert(truth.data, tmp_path / "native").main()
    native = NativeDataParserConfig(data=tmp_path / "native", **AS_RECORDED)
    configs = config_of(truth.format, truth.data, **AS_RECORDED), native
    before, after = (parse(config).metadata[SCENE_KEY] for config in configs)
    # Equal lenses have equal rays.
    for key in ("event_camera", "sensor", "window", "image_encoding", "bounded"):
        assert getattr(before, key) == getattr(after, key), key
    assert torch.equal(before.trajectory.times, after.trajectory.times)
    assert_same_poses(after.trajectory.camera_to_worlds, before.trajectory.camera_to_worlds.numpy())
    np.testing.assert_array_equal(read(before.event_file), read(after.event_file))


def test_hidden_files_of_macos_change_nothing(truth: Truth) -> None:
    before = recording_of(config_of(truth.format, truth.data))
    for path in list(truth.data.rglob("*")):
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7")
    assert recognize(truth.data) == truth.format
    after = recording_of(config_of(truth.format, truth.data))
    np.testing.assert_array_equal(read(after.event_file), read(before.event_file))
    for split, views in before.reference_views.items():
        assert [view.file for view in after.reference_views[split]] == [view.file for view in views]
    assert_same_poses(after.trajectory.camera_to_worlds, before.trajectory.camera_to_worlds.numpy())


# The events and the poses of each format, and the number of frames with times of their own.
FILES = {
    "robust-enerf-data": ("raw_events.npz", "camera_poses.npz", 0),
    "tum-vie-data": ("mocap-desk2-events_left.h5", "mocap-desk2-vi_gt_data/mocap_data.txt", 0),
    "eds-data": ("events.h5", "stamped_groundtruth.txt", 3),
    "enerf-esim-data": ("events", "scene_poses_all.txt", 3),
    "eventnerf-data": ("train/events", "train/pose", 0),
    "paev3d-data": ("H5_Files/Bunny/event.h5", "Render_info", 0),
    "event-recording-data": ("events.h5", "trajectory.txt", 4),
}


def test_run_opens_without_events_and_elsewhere(truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert recognize(truth.data) == truth.format
    monkeypatch.chdir(tmp_path)
    config = EventDataManagerConfig(dataparser=AutomaticDataParserConfig(data=Path(truth.data.name)))
    manager = config.setup(device="cpu", test_mode="inference", world_size=1, local_rank=0)
    resolved = manager.resolved_config()
    assert type(resolved.dataparser) is type(FORMATS[truth.format])
    # The defaults, which all runs share, are unchanged.
    assert FORMATS[truth.format].start_time_ns is None
    assert FORMATS[truth.format].data == type(FORMATS[truth.format])().data
    saved = yaml.dump(resolved)
    remove(FILES[truth.format][0])(truth.data)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    again = yaml.load(saved, Loader=yaml.Loader).setup(device="cpu", test_mode="inference", world_size=1, local_rank=0)
    assert torch.equal(manager.train_dataset.cameras.camera_to_worlds, again.train_dataset.cameras.camera_to_worlds)
    assert manager.train_dataset.scene.window == again.train_dataset.scene.window
    assert again.train_dataset.get_numpy_image(0).std() == 0
    for before, after in zip(manager.eval_dataset.image_filenames, again.eval_dataset.image_filenames, strict=True):
        assert before == after


def test_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    message = r"no known format of recordings; looked for .*raw_events.npz.*H5_Files"
    with pytest.raises(DataError, match=message) as error:
        recognize(tmp_path)
    for name in FORMATS:
        assert name in str(error.value)
    with pytest.raises(DataError, match="nowhere: there is no such folder"):
        recognize(tmp_path / "nowhere")
    with pytest.raises(SystemExit, match=r"^Error: .*no known format"):
        EventDataManagerConfig(dataparser=AutomaticDataParserConfig(data=tmp_path)).setup(device="cpu")


def test_a_stated_lens_is_not_that_of_eds(tmp_path: Path) -> None:
    for name in ("events.h5", "stamped_groundtruth.txt"):
        (tmp_path / name).touch()
    assert recognize(tmp_path) == "eds-data"
    (tmp_path / "calibration.json").touch()
    assert recognize(tmp_path) == "event-recording-data"


def test_errors_say_that_the_format_was_guessed(tmp_path: Path) -> None:
    # Another recording's folders, of the names that PAEv3D has.
    (tmp_path / "H5_Files" / "mine").mkdir(parents=True)
    guessed = AutomaticDataParserConfig(data=tmp_path).setup()
    with pytest.raises(DataError, match=r"Render_info.mine: .*the format paev3d-data was guessed: .* --format"):
        guessed.get_dataparser_outputs("train")
    with pytest.raises(DataError) as error:
        config_of("paev3d-data", tmp_path).setup().get_dataparser_outputs("train")
    assert "guessed" not in str(error.value)


def test_poses_may_be_missing(truth: Truth) -> None:
    known = recording_of(config_of(truth.format, truth.data))
    _, poses, num_frames = FILES[truth.format]
    remove(poses)(truth.data)
    # The other files of EDS are those of many formats.
    if truth.format == "eds-data":
        (truth.data / "calibration.json").write_text("{}")
        assert recognize(truth.data) == "event-recording-data"
    else:
        assert recognize(truth.data) == truth.format
    parser = config_of(truth.format, truth.data).setup()
    with pytest.raises(DataError, match=r"no such poses; .* aenerf convert DATA --output FOLDER --poses events"):
        parser.get_dataparser_outputs("train")
    capture, frames = parser.read_frames()
    assert not isinstance(capture, Recording)
    assert len(frames) == num_frames
    assert (capture.event_camera, capture.sensor) == (known.event_camera, known.sensor)
    assert capture.event_file.path == known.event_file.path


def test_estimated_poses_may_be_given(truth: Truth, tmp_path: Path) -> None:
    other = truth.poses.copy()
    other[:, :3, 3] += 0.01
    write_poses(tmp_path / "other.txt", other, seconds(truth.times))
    recording = recording_of(config_of(truth.format, truth.data, trajectory=tmp_path / "other.txt"))
    assert recording.ground_truth is not None
    assert_same_poses(recording.ground_truth.camera_to_worlds, truth.poses)
    assert_same_poses(recording.trajectory.camera_to_worlds, other)
