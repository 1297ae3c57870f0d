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

_REMEDY = "give the camchain that Kalibr wrote"


class _Camera(msgspec.Struct, kw_only=True):
    """A camera of the chain. ``T_cn_cnm1`` takes points from the coordinates of the camera before it to its own."""

    intrinsics: Row
    resolution: tuple[int, int]
    camera_model: Literal["pinhole"] = "pinhole"
    distortion_model: str = "radtan"
    distortion_coeffs: list[float] = []
    T_cn_cnm1: Matrix | None = None

    def __post_init__(self) -> None:
        if self.distortion_model != "none" and len(self.distortion_coeffs) != 4:
            raise ValueError(f"it has {len(self.distortion_coeffs)} distortion_coeffs, not 4")
        self.lens()

    def lens(self) -> CameraIntrinsics:
        distortion = [] if self.distortion_model == "none" else self.distortion_coeffs
        return CameraIntrinsics.from_opencv(self.resolution, self.intrinsics, distortion, self.distortion_model)


def read_camchain(path: Path) -> dict[str, tuple[CameraIntrinsics, Tensor]]:
    """Read the cameras of a camchain by name: each lens, and the (4, 4) float64 matrix that takes points from the
    first camera's coordinates to its own.

    Raises:
        DataError: the file is missing or malformed, or a camera model is not supported.
    """
    chain = convert(path, read_plain_yaml(path), dict[str, Any], _REMEDY)
    # Some datasets add matrices beside the cameras, such as MVSEC its T_cam0_lidar.
    chain = {name: value for name, value in chain.items() if isinstance(value, dict)}
    if not chain:
        raise DataError(path, "it holds no camera", _REMEDY)
    cameras: dict[str, tuple[CameraIntrinsics, Tensor]] = {}
    from_first = torch.eye(4, dtype=torch.float64)
    for name in sorted(chain):
        camera = convert(path, chain[name], _Camera, _REMEDY, name)
        if cameras:
            from_first = rigid_motion(path, f"{name}.T_cn_cnm1", camera.T_cn_cnm1) @ from_first
        cameras[name] = (camera.lens(), from_first)
    return cameras
