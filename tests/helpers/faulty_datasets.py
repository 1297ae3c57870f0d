"""Plain faults of datasets of every format: a file, a number or a name that is missing or wrong."""

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from helpers.dataset_faults import (
    Change,
    all_of,
    edit_json,
    edit_npz,
    put,
    remove,
    replace_line,
    saved_as,
    set_attribute,
    set_in,
    write_bytes,
    write_text,
)
from helpers.malformed_inputs import OBJECTS, camchain, camera, unallocated
from helpers.published_datasets import CAMCHAIN, N_POSES, make_poses, write_colmap

# Each fault: a change of the dataset, the end of the path that the error names, and words of its problem or remedy.
Fault = tuple[Change, str, str]

DTYPES = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
MIRRORED, SCALED = np.diag([1.0, 1, -1, 1]).tolist(), np.diag([2.0, 2, 2, 1]).tolist()


native = partial(edit_json, "transforms.json")


def top(**values: object) -> Change:
    return native(lambda meta: meta.update(values))


def frame(**values: object) -> Change:
    return native(lambda meta: meta["frames"][0].update(values))


def column(name: str, values: np.ndarray | None) -> Change:
    return put("events.h5", f"events/{name}", values)


_NATIVE_FAULTS: dict[str, Fault] = {
    "no transforms": (remove("transforms.json"), "transforms.json", "no such file"),
    "no event camera": (native(lambda m: m.pop("event_camera")), "transforms.json", "`event_camera`"),
    "no focal length": (native(lambda m: m["event_camera"].pop("fl_x")), "transforms.json", "event_camera: "),
    "no threshold": (camera(positive_contrast_threshold=None), "transforms.json", "positive_contrast"),
    "negative threshold": (camera(negative_contrast_threshold=-1), "transforms.json", "negative_contrast"),
    "negative bandwidth": (camera(bandwidth_hz=-1.0), "transforms.json", "bandwidth must be 0, or from"),
    "negative blindness": (camera(refractory_period_ns=-1), "transforms.json", "refractory_period must be from 0"),
    "unknown Bayer pattern": (camera(bayer_pattern="RGBG"), "transforms.json", '"RGBG"'),
    "unknown lens": (camera(camera_model="KB4"), "transforms.json", "event_camera: the lens model is 'KB4'"),
    "p1 of a fisheye": (camera(camera_model="OPENCV_FISHEYE", p1=0.1), "transforms.json", "event_camera: p1 is 0.1"),
    "k4 without a fisheye": (top(k4=-0.1), "transforms.json", "k4 is -0.1, which camera_model OPENCV does not have"),
    "Kalibr's distortion": (camera(distortion_coeffs=[0.1]), "transforms.json", "distortion_coeffs, which is not read"),
    "model of distortion": (top(distortion_model="kb4"), "transforms.json", "distortion_model, which is not read"),
    "Fisheye of instant-ngp": (top(is_fisheye=True), "transforms.json", "is_fisheye, which is not read; state camera"),
    "model by another name": (camera(lens_model="fisheye"), "transforms.json", "lens_model, which is not read"),
    "image of another size": (saved_as("PNG", "images/val/00000.png", (3, 2)), "val/00000.png", "3 x 2 pixels"),
    "BMP": (saved_as("BMP", "images/val/00000.png"), "val/00000.png", "save it as PNG or JPEG, or copy it again if"),
    "mirrored pose": (frame(transform_matrix=MIRRORED), "frames[0].transform_matrix", "not a rigid motion"),
    "scaled mount": (camera(T_frame_event=SCALED), "event_camera.T_frame_event", "not a rigid motion"),
    "frame twice": (native(lambda m: m["frames"].append(m["frames"][0])), "transforms.json", "train/00000.png again"),
    "box inside out": (top(scene_box=[[1] * 3, [0] * 3]), "transforms.json", "scene_box"),
    "missing image": (remove("images/val/00000.png"), "transforms.json", "val/00000.png, which does not exist"),
    "unknown image": (top(test_filenames=["x.png"]), "transforms.json", "test_filenames"),
    "no pose and time": (frame(transform_matrix=None, timestamp=None), "transforms.json", "frames[0] has neither"),
    "no event file": (remove("events.h5"), "events.h5", "no such file"),
    "no name of events": (camera(file=None), "transforms.json", "file"),
    "no column": (column("p", None), "events.h5", "/events/p"),
    "wrong dtype": (column("t", np.zeros(200)), "events.h5", "/events/t has type float64"),
    "no events": (all_of(*(column(n, np.zeros(0, dtype)) for n, dtype in DTYPES.items())), "events.h5", "no events"),
    "10^12 rows": (unallocated("events.h5", DTYPES, "events/"), "events.h5", "unpacks to 13,000,000,000,000 bytes"),
    "fractional offset": (set_attribute("time_offset", 0.5), "events.h5", "time_offset is 0.5"),
    "offset is NaN": (set_attribute("time_offset", np.nan), "events.h5", "time_offset is nan"),
    "unknown unit": (set_attribute("time_unit", "fortnight"), "events.h5", "time unit is 'fortnight'"),
    "polarity 0": (column("p", np.zeros(200, np.int8)), "events.h5", "polarity 0"),
    "no poses": (remove("trajectory_estimated.txt"), "trajectory_estimated.txt", "no such poses"),
}


pose = partial(replace_line, "groundtruth.txt", 2)


def image_times(ticks: int) -> Change:
    """The times of the images, in ticks of a second."""
    lines = [f"{(2 * index + 1) * ticks // 20} images/{index}.png\n" for index in range(4)]
    return write_text("images.txt", "".join(lines))


LATE = write_text("groundtruth.txt", "5 0 0 0 0 0 0 1\n6 1 0 0 0 0 0 1\n")
_ECD_FAULTS: dict[str, Fault] = {
    "no folder": (shutil.rmtree, "made", "no such folder"),
    "no calibration": (remove("calib.txt"), "calib.txt", "no such file"),
    "missing image": (remove("images/1.png"), "images.txt", "images/1.png, which does not exist"),
    "image times in ms": (image_times(10**3), "images", "images were in milliseconds"),
    "image times in us": (image_times(10**6), "images", "images were in microseconds"),
    "image times in ns": (image_times(10**9), "images", "images were in nanoseconds"),
    "NaN pose": (pose("0.2 nan 0 0 0 0 0 1"), "groundtruth.txt", "pose 2 holds nan"),
    "long quaternion": (pose("0.2 0 0 0 0 0 1 1"), "groundtruth.txt", "pose 2 holds 0 0 0 0 0 1 1"),
    "seven numbers": (pose("0.2 0 0 0 0 0 1"), "groundtruth.txt", "line 3 has 7 fields"),
    "pose is a word": (pose("0.2 x 0 0 0 0 0 1"), "groundtruth.txt", "'x'"),
    "pose time is a word": (pose("now 0 0 0 0 0 0 1"), "groundtruth.txt", "now is not a time in seconds"),
    "one pose": (write_text("groundtruth.txt", "0 0 0 0 0 0 0 1\n"), "groundtruth.txt", "1 poses"),
    "no pose": (write_text("groundtruth.txt", "# nothing\n"), "groundtruth.txt", "no poses"),
    "no overlap": (LATE, "groundtruth.txt", "do not overlap the events from 10000000 to 310000000 ns"),
    "short calibration": (write_text("calib.txt", "5 5.5 2.5 1.5\n"), "calib.txt", "line 1 has 4 fields"),
    "empty calibration": (write_text("calib.txt", ""), "calib.txt", "empty"),
    "no focal length": (write_text("calib.txt", "0 5 2 1 0 0 0 0 0\n"), "calib.txt", "fx must be from 0.01"),
}

CALIBRATION, POSES, VIEWS = "camera_calibration.npz", "camera_poses.npz", "views/transforms_val.json"


_ROBUST_FAULTS: dict[str, Fault] = {
    "no intrinsics": (edit_npz(CALIBRATION, intrinsics=None), CALIBRATION, "no array intrinsics"),
    "flat intrinsics": (edit_npz(CALIBRATION, intrinsics=np.ones(9)), CALIBRATION, "intrinsics: expected `array`"),
    "unknown lens": (edit_npz(CALIBRATION, distortion_model="fov"), CALIBRATION, "the lens model is 'fov'"),
    "six distortions": (edit_npz(CALIBRATION, distortion_params=np.zeros(6)), CALIBRATION, "takes 5 numbers, not 6"),
    "NaN threshold": (edit_npz(CALIBRATION, pos_contrast_threshold=np.nan), CALIBRATION, "positive_contrast"),
    "decimal times": (edit_npz(POSES, T_wc_timestamp=np.zeros(N_POSES)), POSES, "T_wc_timestamp has type float64"),
    "fewer times": (edit_npz(POSES, T_wc_timestamp=np.arange(3)), POSES, "T_wc_position has type float64 and shape"),
    "no image": (remove("views/val/r_1.png"), VIEWS, "frames[1] names ./val/r_1"),
    "no angle": (edit_json(VIEWS, lambda m: m.pop("camera_angle_x")), VIEWS, "neither camera_angle_x nor intrinsics"),
    "angle is 0": (set_in(VIEWS, "camera_angle_x", value=0), VIEWS, "camera_angle_x"),
    "other angle": (set_in(VIEWS, "camera_angle_x", value=1), "transforms_test.json", "that of the other split"),
}

CAMERAS, TRUTH = "camera-calibrationA.json", "mocap-desk2-vi_gt_data"


_TUM_VIE_FAULTS: dict[str, Fault] = {
    "no calibration": (remove("camera-*"), CAMERAS, "no such file"),
    "pinhole": (set_in(CAMERAS, "value0", "intrinsics", 2, "camera_type", value="ds"), CAMERAS, "[2].camera_type"),
    "a word": (replace_line(f"{TRUTH}/mocap_data.txt", 1, "early 0 0 0 0 0 0 1"), "mocap_data.txt", "in microseconds"),
    "lost image": (remove(f"{TRUTH}/left_images/00001.jpg"), "image_timestamps_left.txt", "3 times for 2 images"),
}

TIMES, SECONDS = "images_timestamps.txt", "1600000000.1\n1600000000.8\n1600000001.7\n"
_EDS_FAULTS: dict[str, Fault] = {
    "image times in seconds": (write_text(TIMES, SECONDS), "images", "images were 1,000,000 times too small"),
    "huge time": (write_text(TIMES, "1\n2\n1e99999999\n"), TIMES, "1e99999999 is not a time"),
}


def bounds(array: np.ndarray) -> Change:
    return lambda folder: np.save(folder / "poses_bounds.npy", array)


_ESIM_FAULTS: dict[str, Fault] = {
    "empty folder": (remove("events/*"), "events", "no *.npy"),
    "two lists": (write_text("other_poses_all.txt", ""), "made", "2 files *poses_all*.txt"),
    "small bounds": (bounds(np.zeros((12, 4))), "poses_bounds.npy", "shape (12, 4)"),
    "NaN bounds": (bounds(np.full((12, 17), np.nan)), "poses_bounds.npy", "width must be a whole number"),
    "unsorted files": (lambda folder: (folder / "events/2.npy").rename(folder / "events/20.npy"), "events", "before"),
}

MATRIX = "train/pose/r_00003.txt"
_EVENTNERF_FAULTS: dict[str, Fault] = {
    "no events": (remove("train/events"), "events.npz", "no such file"),
    "two event files": (lambda folder: np.savez(folder / "train/events/b.npz"), "train/events", "2 files *.npz"),
    "no split": (remove("train"), "made", "0 training splits"),
    "no intrinsics": (remove("train/intrinsics/*"), "train/intrinsics", "no *.txt"),
    "3 x 4": (write_text(MATRIX, "1 " * 12), MATRIX, "12 numbers"),
    "NaN pose": (write_text(MATRIX, "nan " * 16), MATRIX, "not finite"),
    "mirrored": (write_text(MATRIX, "1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1"), "train/pose", "pose 3 is not a rigid"),
    "lost image": (remove("train/rgb/00003.png"), "train/rgb", "20 images for 21 poses"),
}


def objects(*values: dict) -> Change:
    return lambda folder: np.savez(folder / OBJECTS, object_poses=list(values))


_PAEV3D_FAULTS: dict[str, Fault] = {
    "no poses": (remove("Render_info/Bunny/*.npz"), "Render_info/Bunny", "no *.npz"),
    "no camera": (objects({"name": "Bunny"}), "0003.npz", "no 'Camera'"),
    "pose of words": (objects({"name": "Camera", "pose": np.full((4, 4), "1")}), "0003.npz", "no 'Camera' with a pose"),
    "small pose": (objects({"name": "Camera", "pose": np.eye(3)}), "0003.npz", "no 'Camera' with a pose"),
    "NaN pose": (objects({"name": "Camera", "pose": np.full((4, 4), np.nan)}), "0003.npz", "not a rigid motion"),
}


def kalibr(name: str, **values: object) -> Change:
    return camchain(yaml.dump({**CAMCHAIN, name: {**CAMCHAIN[name], **values}}))


def colmap(make: Change = lambda folder: None) -> Change:
    return all_of(remove("trajectory.txt"), lambda folder: (folder / "colmap").mkdir(), make)


def other_images(folder: Path) -> None:
    write_colmap(folder / "colmap/sparse/0", make_poses(2), ["00000.png", "other.png"])


WIDE_LENS = write_text("colmap/sparse/0/cameras.txt", f"1 PINHOLE {'9' * 400} 40 50 51 30 20\n")
INFINITE = np.full((4, 4), np.inf).tolist()
_OWN_FAULTS: dict[str, Fault] = {
    "no folder": (shutil.rmtree, "made", "no such folder"),
    "no events": (remove("events.h5"), "made", "0 files events{.raw,"),
    "two event files": (write_text("events.csv", ""), "made", "2 files events"),
    "no calibration": (remove("calibration.json"), "events.h5", "does not state the size of its sensor"),
    "offset is a word": (put("events.h5", "t_offset", "late"), "events.h5", "late"),
    "image without time": (write_text("images.txt", "00001.png\n"), "images.txt", "line 1 has 1 fields"),
    "COLMAP without times": (all_of(remove("images.txt"), colmap()), "images.txt", "no such list"),
    "empty COLMAP": (colmap(), "colmap", "no COLMAP model"),
    "COLMAP of other images": (colmap(other_images), "images.txt", "it lists other.png 0 times"),
    "COLMAP camera of inf": (
        colmap(write_text("colmap/images.txt", "1 1 0 0 0 0 0 0 inf a\n")),
        "images.txt",
        "line 1 is",
    ),
    "COLMAP lens of 400 digits": (colmap(all_of(other_images, WIDE_LENS)), "cameras.txt", "a camera cannot be read"),
    "broken COLMAP": (colmap(write_bytes("colmap/images.bin", b"\1")), "images.bin", "not a COLMAP model"),
    "unknown distortion": (kalibr("cam0", distortion_model="fov", distortion_coeffs=[1]), "camchain.yaml", "is 'fov'"),
    "unknown camera": (kalibr("cam0", camera_model="omni"), "camchain.yaml", "calibrate again with pinhole-radtan or"),
    "three distortions": (kalibr("cam0", distortion_coeffs=[0.1, 0, 0]), "camchain.yaml", "3 distortion_coeffs"),
    "infinite mount": (kalibr("cam1", T_cn_cnm1=INFINITE), "cam1.T_cn_cnm1", "not a rigid motion"),
    "camchain of numbers": (camchain("cam0: 3"), "camchain.yaml", "no camera"),
    "no YAML": (camchain("{:"), "camchain.yaml", "not valid YAML"),
}

_FAULTS = {
    "aenerf-data": _NATIVE_FAULTS,
    "ecd-data": _ECD_FAULTS,
    "robust-enerf-data": _ROBUST_FAULTS,
    "tum-vie-data": _TUM_VIE_FAULTS,
    "eds-data": _EDS_FAULTS,
    "enerf-esim-data": _ESIM_FAULTS,
    "eventnerf-data": _EVENTNERF_FAULTS,
    "paev3d-data": _PAEV3D_FAULTS,
    "event-recording-data": _OWN_FAULTS,
}
FAULTS = {f"{kind}: {name}": (kind, *fault) for kind, faults in _FAULTS.items() for name, fault in faults.items()}
"""By a name: the format of a whole dataset, the change, the end of the error's source, and a part of what it says."""
