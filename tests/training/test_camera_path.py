"""The camera path of ``ns-render camera-path``, checked before the run is opened."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.training.preflight import require_camera_path

CAMERA = {"camera_to_world": [0.0] * 16, "fov": 75.0}
CAMERA_PATH = {"seconds": 1.0, "render_width": 48, "render_height": 36, "camera_path": [CAMERA]}


def require(content: dict[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "path.json"
    path.write_text(json.dumps(content))
    options = ["--load-config", "x", f"--camera_path_filename={path}"]
    monkeypatch.setattr(sys, "argv", ["ns-render", "camera-path", *options])
    require_camera_path()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"seconds": None}, "seconds: expected `float`"),
        ({"seconds": 0}, "seconds: "),
        ({"render_width": ...}, "missing required field `render_width`"),
        ({"camera_path": ...}, "missing required field `camera_path`"),
        ({"camera_path": []}, "camera_path: "),
        ({"camera_path": [{"fov": 75.0}]}, "missing required field `camera_to_world`"),
        ({"camera_path": [{**CAMERA, "fov": None}]}, "no field of view `fov`"),
        ({"camera_path": [{**CAMERA, "camera_to_world": [0.0] * 12}]}, "camera_to_world does not have 16 numbers"),
    ],
)
def test_a_camera_path_that_cannot_be_rendered_is_one_line(
    change: dict[str, Any], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = {key: value for key, value in (CAMERA_PATH | change).items() if value is not ...}
    with pytest.raises(DataError) as error:
        require(content, tmp_path, monkeypatch)
    assert error.value.source == tmp_path / "path.json"
    assert problem in error.value.problem
    assert "Render tab" in error.value.remedy


def test_panoramas_need_no_field_of_view_and_other_commands_no_camera_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panorama = CAMERA_PATH | {"camera_type": "equirectangular", "camera_path": [{**CAMERA, "fov": None}]}
    require(panorama, tmp_path, monkeypatch)
    monkeypatch.setattr(sys, "argv", ["ns-render", "interpolate"])
    require_camera_path()
