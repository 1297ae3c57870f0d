"""Cameras in the YAML that Kalibr writes ("camchain")."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics, LensModel
from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.json_object import JsonObject, require_shallow
from aenerf_ns.files.plain_yaml import read_plain_yaml

_LENS_MODELS: dict[str, LensModel] = {
    "radtan": "radial_tangential",
    "equidistant": "fisheye",
    "none": "radial_tangential",
}


def read_camchain(path: Path) -> dict[str, tuple[CameraIntrinsics, Tensor]]:
    """Read the cameras of a camchain, by their names.

    Returns:
        For each camera its lens, and the (4, 4) float64 matrix that takes points from the first camera's coordinates to
        its own.

    Raises:
        DataError: the file is missing or malformed, or a camera model is not supported.
    """
    with reading(path):
        if not path.is_file():
            raise DataError(path, "there is no such file", "give the camchain that Kalibr wrote")
    chain = read_plain_yaml(path)
    if not isinstance(chain, dict) or not all(isinstance(name, str) for name in chain):
        raise DataError(path, "not a list of cameras", "give the camchain that Kalibr wrote")
    require_shallow(path, chain)
    # Some datasets add matrices beside the cameras, such as MVSEC its T_cam0_lidar.
    chain = {name: value for name, value in chain.items() if isinstance(value, dict)}
    if not chain:
        raise DataError(path, "not a list of cameras", "give the camchain that Kalibr wrote")
    cameras: dict[str, tuple[CameraIntrinsics, Tensor]] = {}
    from_first = torch.eye(4, dtype=torch.float64)
    for name in sorted(chain):
        meta = JsonObject(path, chain[name], f"{name}.")
        step = meta.rigid_motion("T_cn_cnm1")
        if cameras and step is not None:
            from_first = step @ from_first
        cameras[name] = (_camera(meta), from_first)
    return cameras


def _camera(meta: JsonObject) -> CameraIntrinsics:
    if meta.get("camera_model", str, "pinhole") != "pinhole":
        raise meta.error("camera_model", f"is {meta.get('camera_model', str)!r}, not 'pinhole'")
    model = meta.get("distortion_model", str, "radtan")
    if model not in _LENS_MODELS:
        raise meta.error("distortion_model", f"is {model!r}, not one of {', '.join(_LENS_MODELS)}")
    lens = _LENS_MODELS[model]
    fx, fy, cx, cy = meta.numbers("intrinsics", meta.get("intrinsics", list), (4,)).tolist()
    width, height = meta.numbers("resolution", meta.get("resolution", list), (2,)).tolist()
    distortion = [0.0] * 4
    if model != "none":
        distortion = meta.numbers("distortion_coeffs", meta.get("distortion_coeffs", list), (4,)).tolist()
    if lens == "radial_tangential":
        distortion.append(0.0)
    try:
        # Kalibr puts the origin at the centre of the first pixel, this project at its corner.
        return CameraIntrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5, lens, tuple(distortion))
    except ValueError as error:
        raise meta.error("intrinsics:", str(error)) from None
