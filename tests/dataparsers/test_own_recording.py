"""The user's own recording: events, calibration and poses from any source."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.dataset_faults import assert_one_clear_line, edit_json, remove, write_text
from helpers.published_datasets import (
    CALIBRATION,
    EPOCH,
    assert_same_poses,
    config_of,
    make_poses,
    recording_of,
    write_own,
)
from helpers.streams import FUZZ_EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.dataparsers.formats import recognize
from aenerf_ns.dataparsers.own_recording import OwnRecordingDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.kalibr import read_camchain


def test_own_recordings_have_views_at_their_times(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data))
    assert recording.sensor == SensorModel(0.3, 0.2, 100)
    assert recording.image_encoding == "linear"
    # The fourth image is after the last pose.
    assert [view.time - EPOCH * 1_000 for view in recording.reference_views["train"]] == [0, 5 * 10**8, 10**9]
    view = recording.reference_views["test"][0]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5], rtol=0, atol=1e-9)


def test_own_recordings_may_be_put_together_from_anywhere(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    (tmp_path / "parts").mkdir()
    renamed = {"events": "record.hdf5", "calibration": "cameras.json", "poses": "mocap.txt", "images": "stamps.txt"}
    for name, new in (
        ("events.h5", "record.hdf5"),
        ("calibration.json", "cameras.json"),
        ("trajectory.txt", "mocap.txt"),
    ):
        (truth.data / name).rename(tmp_path / "parts" / new)
    shutil.move(truth.data / "images", tmp_path / "parts" / "images")
    (truth.data / "images.txt").rename(tmp_path / "parts" / "stamps.txt")
    options = {name: tmp_path / "parts" / new for name, new in renamed.items()}
    recording = recording_of(OwnRecordingDataParserConfig(data=tmp_path / "parts", **options))
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses)
    assert len(recording.reference_views["train"]) == 3
    assert recording.event_file.time_span()[0] == EPOCH * 1_000


CAMCHAIN = {
    "cam0": {
        "camera_model": "pinhole",
        "distortion_model": "equidistant",
        "intrinsics": [70.0, 71.0, 40.0, 30.0],
        "resolution": [80, 60],
        "distortion_coeffs": [0.01, 0.02, 0.03, 0.04],
        "rostopic": "/frames",
    },
    "cam1": {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [50.0, 51.0, 29.5, 20.0],
        "resolution": [60, 40],
        "distortion_coeffs": [-0.1, 0.0, 0.0, 0.01],
        "T_cn_cnm1": make_poses(3)[2].tolist(),
    },
}


def test_kalibrs_camchain_places_both_cameras(tmp_path: Path) -> None:
    truth = write_own(tmp_path / "made")
    (truth.data / "calibration.json").unlink()
    (truth.data / "camchain.yaml").write_text(yaml.dump(CAMCHAIN))
    with pytest.raises(DataError, match="its cameras are cam0, cam1; name that of the events as --event-camera"):
        recording_of(OwnRecordingDataParserConfig(data=truth.data))
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data, event_camera="cam1", frame_camera="cam0"))
    assert recording.event_camera == CameraIntrinsics(60, 40, 50.0, 51.0, 30.0, 20.5, distortion=(-0.1, 0, 0, 0.01, 0))
    assert recording.frame_camera == CameraIntrinsics(
        80, 60, 70.0, 71.0, 40.5, 30.5, "fisheye", (0.01, 0.02, 0.03, 0.04)
    )
    # T_cn_cnm1 takes points from cam0, the frames, to cam1, the events.
    view = recording.reference_views["train"][1]
    np.testing.assert_allclose(view.camera_to_world.numpy(), truth.poses[5] @ make_poses(3)[2], rtol=0, atol=1e-9)
    # And the other way round.
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data, event_camera="cam0", frame_camera="cam1"))
    expected = truth.poses[5] @ np.linalg.inv(make_poses(3)[2])
    np.testing.assert_allclose(
        recording.reference_views["train"][1].camera_to_world.numpy(), expected, rtol=0, atol=1e-9
    )


def write_colmap(folder: Path, poses: NDArray[np.float64], names: list[str]) -> None:
    """COLMAP's text model: world-to-camera, qw first."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 60 40 50 51 30 20.5\n")
    lines = []
    for index, (pose, name) in enumerate(zip(poses, names, strict=True), start=1):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat().tolist()
        values = [w, x, y, z, *inverse[:3, 3].tolist()]
        lines.append(f"{index} {' '.join(map(repr, values))} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


@pytest.mark.parametrize("place", ["colmap", "colmap/sparse/0"])
def test_a_colmap_model_gives_poses_at_the_times_of_its_images(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_own(tmp_path / "made")
    (truth.data / "trajectory.txt").unlink()
    shift = make_poses(3)[1]
    calibration = json.loads(json.dumps(CALIBRATION))
    calibration["event_camera"]["T_frame_event"] = shift.tolist()
    (truth.data / "calibration.json").write_text(json.dumps(calibration))
    # Images 2, 0 and 1 in this order; of image 3 COLMAP made nothing.
    write_colmap(truth.data / place, truth.poses[[10, 0, 5]], ["00002.png", "00000.png", "00001.png"])
    assert recognize(truth.data) == "event-recording-data"
    recording = recording_of(OwnRecordingDataParserConfig(data=truth.data))
    assert (recording.trajectory.times - EPOCH * 1_000).tolist() == [0, 5 * 10**8, 10**9]
    assert_same_poses(recording.trajectory.camera_to_worlds, truth.poses[[0, 5, 10]] @ shift, 1e-7)
    assert "COLMAP placed 3 of the 4 images" in capsys.readouterr().out
    # The images are where COLMAP put them.
    for view, pose in zip(recording.reference_views["train"], truth.poses[[0, 5, 10]], strict=True):
        np.testing.assert_allclose(view.camera_to_world.numpy(), pose, rtol=0, atol=1e-7)


SCALED = np.diag([2.0, 2, 2, 1]).tolist()
FAULTS = {
    "no folder": (lambda folder: shutil.rmtree(folder), "made: there is no such folder"),
    "no events": (remove("events.h5"), r"it holds 0 files events\{.raw,"),
    "two event files": (write_text("events.csv", ""), "it holds 2 files events"),
    "no calibration": (remove("calibration.json"), "it holds 0 of calibration.json and camchain.yaml"),
    "no poses": (remove("trajectory.txt"), "trajectory.txt: there is no such file"),
    "no JSON": (write_text("calibration.json", "fx"), "calibration.json: not valid JSON"),
    "no event camera": (write_text("calibration.json", "{}"), "required field `event_camera`"),
    "negative threshold": (
        edit_json("calibration.json", lambda m: m["event_camera"].update(positive_contrast_threshold=-1)),
        "calibration.json: positive_contrast_threshold must be",
    ),
    "unknown lens": (
        edit_json("calibration.json", lambda m: m["event_camera"].update(camera_model="FOV")),
        "event_camera: the lens model is 'FOV'",
    ),
    "unknown encoding": (
        edit_json("calibration.json", lambda m: m.update(image_encoding="log")),
        "image_encoding: invalid enum value 'log'",
    ),
    "scaled mount": (
        edit_json("calibration.json", lambda m: m["event_camera"].update(T_frame_event=SCALED)),
        "T_frame_event: pose 0 is not a rigid motion",
    ),
    "missing image": (remove("images/00001.png"), "images.txt: it names images/00001.png, which does not exist"),
    "image without time": (write_text("images.txt", "00001.png\n"), "images.txt: line 1 has 1 fields"),
    "COLMAP without images.txt": (
        lambda folder: (remove("[ti]*.txt")(folder), (folder / "colmap").mkdir()),
        "images.txt: there is no such list of images",
    ),
    "empty COLMAP": (
        lambda folder: (remove("trajectory.txt")(folder), (folder / "colmap").mkdir()),
        "colmap: there is no COLMAP model",
    ),
    "COLMAP of other images": (
        lambda folder: (
            remove("trajectory.txt")(folder),
            write_colmap(folder / "colmap", make_poses(2), ["00000.png", "other.png"]),
        ),
        "images.txt: it lists other.png 0 times",
    ),
    "broken COLMAP": (
        lambda folder: (
            remove("trajectory.txt")(folder),
            (folder / "colmap").mkdir(),
            (folder / "colmap" / "images.bin").write_bytes(b"\1"),
        ),
        "images.bin: not a COLMAP model",
    ),
    "unknown distortion": (
        lambda folder: (
            remove("calibration.json")(folder),
            (folder / "camchain.yaml").write_text(
                yaml.dump({"cam0": {**CAMCHAIN["cam0"], "distortion_model": "fov"}})
            ),
        ),
        "camchain.yaml: cam0: the lens model is 'fov', not one of",
    ),
    "camchain of numbers": (
        lambda folder: (remove("calibration.json")(folder), (folder / "camchain.yaml").write_text("cam0: 3")),
        "camchain.yaml: it holds no camera",
    ),
    "no YAML": (
        lambda folder: (remove("calibration.json")(folder), (folder / "camchain.yaml").write_text("{:")),
        "camchain.yaml: not valid YAML",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_malformed_datasets_are_one_clear_line(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    config = config_of("event-recording-data", write_own(tmp_path / "made").data)
    assert_one_clear_line(change, message, config)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=6,
)


def damage(data: st.DataObject, value: object) -> object:
    """Replaces, drops or adds something somewhere in a tree of dictionaries and lists."""
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not keys or data.draw(st.integers(0, 5)) == 0:
        return data.draw(JSON)
    key = data.draw(st.sampled_from(keys))
    copy = dict(value) if isinstance(value, dict) else list(value)  # type: ignore[call-overload]
    if data.draw(st.integers(0, 5)) == 0:
        del copy[key]
    else:
        copy[key] = damage(data, copy[key])
    return copy


@settings(max_examples=3 * FUZZ_EXAMPLES, deadline=None)
@given(st.data())
def test_no_calibration_crashes_its_readers(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.getbasetemp() / "fuzzed"
    if not folder.exists():
        write_own(folder)
    yaml_file, json_file = folder.parent / "fuzzed.yaml", folder.parent / "fuzzed.json"
    yaml_file.write_text(yaml.dump(damage(data, CAMCHAIN)))
    json_file.write_text(json.dumps(damage(data, CALIBRATION)))
    for read in (
        lambda: read_camchain(yaml_file),
        lambda: recording_of(OwnRecordingDataParserConfig(data=folder, calibration=json_file)),
    ):
        try:
            read()
        except DataError as error:
            assert "\n" not in str(error)  # noqa: PT017
