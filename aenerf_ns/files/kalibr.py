"""Cameras in the YAML that Kalibr writes ("camchain")."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from aenerf_ns.camera.lens import EventCamera, LensModel
from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.boundary import read_text
from aenerf_ns.files.json_object import JsonObject, require_shallow

_LENS_MODELS: dict[str, LensModel] = {
    "radtan": "radial_tangential",
    "equidistant": "fisheye",
    "none": "radial_tangential",
}


# A camchain has 1 kB a camera. PyYAML reads 0.1 MB in a second.
_MAX_BYTES = 1 << 17


class _Loader(yaml.SafeLoader):
    """Refuse aliases. Kalibr writes none, and a few of them make a value of any size or one that holds itself."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has aliases, which Kalibr does not write")
        return super().compose_node(parent, index)


def read_camchain(path: Path) -> dict[str, tuple[EventCamera, Tensor]]:
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
    text = read_text(path, _MAX_BYTES)
    try:
        # A safe loader, which makes no objects but lists, dictionaries, texts and numbers.
        chain: Any = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(path, f"not valid YAML ({' '.join(str(error).split())})", "copy it again") from None
    if not isinstance(chain, dict) or not all(isinstance(name, str) for name in chain):
        raise DataError(path, "not a list of cameras", "give the camchain that Kalibr wrote")
    require_shallow(path, chain)
    # Some datasets add matrices beside the cameras, such as MVSEC its T_cam0_lidar.
    chain = {name: value for name, value in chain.items() if isinstance(value, dict)}
    if not chain:
        raise DataError(path, "not a list of cameras", "give the camchain that Kalibr wrote")
    cameras: dict[str, tuple[EventCamera, Tensor]] = {}
    from_first = torch.eye(4, dtype=torch.float64)
    for name in sorted(chain):
        meta = JsonObject(path, chain[name], f"{name}.")
        step = meta.rigid_motion("T_cn_cnm1")
        if cameras and step is not None:
            from_first = step @ from_first
        cameras[name] = (_camera(meta), from_first)
    return cameras


def _camera(meta: JsonObject) -> EventCamera:
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
        return EventCamera(width, height, fx, fy, cx + 0.5, cy + 0.5, lens, tuple(distortion))
    except ValueError as error:
        raise meta.error("intrinsics:", str(error)) from None
