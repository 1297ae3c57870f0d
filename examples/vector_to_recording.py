"""Make a recording of a sequence of VECtor: start it in the folder of the files.

The pose of the event camera is the body's pose · inv(T_cam_body) · T_cam0_cam2. Read in the authors' MPL dataset
toolbox and in DEVO's loader; not yet tried on the real files."""

import json
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

name = "corner_slow1"
folder = Path("vector")
folder.mkdir()


def read(file):
    return yaml.safe_load(Path(file).read_text())


def motion(values):
    return np.array(values, dtype=np.float64).reshape(4, 4)


camera_from_body = motion(read("camera_mocap_extrinsic_results1.yaml")["cam0"]["T_cam_body"])
camera_from_event = motion(read("small_scale_joint_camera_extrinsic_results.yaml")["cam2"]["T_cam0_cam2"])
body_from_event = np.linalg.inv(camera_from_body) @ camera_from_event

with (folder / "trajectory.txt").open("w") as trajectory:
    for time, *position_and_quaternion in np.loadtxt(f"{name}.synced.gt.txt"):
        pose = np.eye(4)
        pose[:3, 3] = position_and_quaternion[:3]
        pose[:3, :3] = Rotation.from_quat(position_and_quaternion[3:]).as_matrix()
        pose = pose @ body_from_event
        values = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        trajectory.write(f"{time:.6f} {' '.join(f'{value:.12g}' for value in values)}\n")

lens = read("left_event_camera_intrinsic_results.yaml")
fx, _, cx, _, fy, cy, *_ = lens["camera_matrix"]["data"]
distortion = dict(zip(("k1", "k2", "p1", "p2", "k3"), lens["distortion_coefficients"]["data"], strict=True))
# The principal point counts from the first pixel's center there, and from its edge here.
camera = {"width": 640, "height": 480, "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, **distortion}
(folder / "calibration.json").write_text(json.dumps({"event_camera": camera}))
