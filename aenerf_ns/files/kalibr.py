"""Cameras in the YAML that Kalibr writes ("camchain")."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import msgspec
import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.files.json_file import convert
from aenerf_ns.files.plain_yaml import read_plain_yaml
from aenerf_ns.files.transforms import Matrix, Row, rigid_motion

_REMEDY = "give the camchain that Kalibr wrote, or calibrate again with pinhole-radtan or pinhole-equi"


class ChainCamera(msgspec.Struct, kw_only=True):
    """A camera of the chain. ``T_cn_cnm1`` takes points from the coordinates of the camera before it to its own."""

    intrinsics: Row
    resolution: tuple[int, int]
    camera_model: Literal["pinhole"] = "pinhole"
    distortion_model: str = "radtan"
    distortion_coeffs: list[float] = []
    T_cn_cnm1: Matrix | None = None

    def __post_init__(self) -> None:
        # The number of coefficients depends on the model, which is looked at first.
        self.lens()
        if self.distortion_model != "none" and len(self.distortion_coeffs) != 4:
            raise ValueError(f"it has {len(self.distortion_coeffs)} distortion_coeffs, not 4")

    def lens(self) -> CameraIntrinsics:
        """Return the camera's lens."""
        distortion = [] if self.distortion_model == "none" else self.distortion_coeffs
        return CameraIntrinsics.from_opencv(self.resolution, self.intrinsics, distortion, self.distortion_model)


def read_camchain(path: Path) -> dict[str, ChainCamera]:
    """Read the cameras of a camchain by name, in the order of the chain.

    Raises:
        DataError: the file is missing or malformed, or a camera model is not supported.
    """
    chain = convert(path, read_plain_yaml(path), dict[str, Any], _REMEDY)
    # Some datasets add matrices beside the cameras, such as MVSEC its T_cam0_lidar.
    chain = {name: value for name, value in chain.items() if isinstance(value, dict)}
    if not chain:
        raise DataError(path, "it holds no camera", _REMEDY)
    cameras: dict[str, ChainCamera] = {}
    # cam10 follows cam9.
    for name in sorted(chain, key=lambda name: (len(name), name)):
        cameras[name] = convert(path, chain[name], ChainCamera, _REMEDY, name)
        if cameras[name].T_cn_cnm1 is not None:
            rigid_motion(path, f"{name}.T_cn_cnm1", cameras[name].T_cn_cnm1)
    return cameras


def motion_between(path: Path, cameras: dict[str, ChainCamera], source: str, target: str) -> Tensor:
    """Return the (4, 4) float64 motion from one camera's to another one's coordinates.

    Raises:
        DataError: the chain does not state the motion between two cameras on the way.
    """
    names = list(cameras)
    first, last = sorted((names.index(source), names.index(target)))
    motion = torch.eye(4, dtype=torch.float64)
    for name in names[first + 1 : last + 1]:
        if cameras[name].T_cn_cnm1 is None:
            raise DataError(path, f"{name} has no T_cn_cnm1", "calibrate both cameras in one run of Kalibr, or add it")
        motion = rigid_motion(path, f"{name}.T_cn_cnm1", cameras[name].T_cn_cnm1) @ motion
    return motion if names.index(source) == first else torch.linalg.inv(motion)
