"""Meshes and scene.json files as scenes, up to the events."""

import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.small_meshes import WALK, painted_box, ray_directions, scene_file

from aenerf_ns.camera.image_encoding import LUMINANCE
from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.errors import DataError
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulation import RAYS_PER_PIXEL

pytestmark = pytest.mark.usefixtures("small_work")

TIN = {"specular": 0.5, "roughness": 0.2}
LAMP = {"center": [0, 0, 3], "half_u": [1, 0, 0], "half_v": [0, -1, 0], "radiance": [9, 9, 9]}
DAY = {"sky": [[0, 0, 0], [1, 1, 1]], "lamps": [LAMP]}


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"mesh": "gone.glb"}, "gone.glb: there is no such file"),
        ({"mesh": "scene.json"}, "unknown kind of mesh"),
        ({"mesh": "../box.glb"}, "outside the folder"),
        ({"mesh": "m" * 5000 + ".glb"}, "cannot be read"),
        ({"up": "x"}, "up: "),
        ({"scale": -1}, "scale: "),
        ({"scale": 1e300}, "scale: "),
        ({"focal_ratio": 1e300}, "focal_ratio: "),
        ({"color": 1}, "unknown field `color`"),
        ({"light": "bright"}, "light: "),
        ({"light": {}}, "either sky or environment"),
        ({"light": {**DAY, "gain": 2}}, "belong to an environment"),
        ({"light": {"sky": [[1, 1, 1], [1, 1, -1]]}}, "light.sky[1][2]: "),
        ({"light": {"sky": [[1] * 3, [1e300] * 3]}}, "light.sky[1][0]: "),
        ({"light": {"environment": "gone.hdr"}}, "gone.hdr: there is no such file; put it there"),
        ({"light": {"environment": "box.glb"}}, "box.glb: not a Radiance picture"),
        ({"light": {**DAY, "lamps": [LAMP] * 101}}, "light.lamps: "),
        ({"light": {**DAY, "lamps": [{**LAMP, "half_v": [0, 0, 0]}]}}, "span no rectangle"),
        ({"light": {**DAY, "lamps": [{"center": [0, 0, 1]}]}}, "light.lamps[0]: "),
        ({"light": DAY, "materials": {"tin": TIN}}, "no surface has the material 'tin'; the file has paint"),
        ({"light": DAY, "materials": {"paint": {"specular": 0.5}}}, "`roughness`"),
        ({"light": DAY, "materials": {"paint": {**TIN, "roughness": 1}}}, "roughness: "),
        ({"materials": {"paint": TIN}}, "the light is baked"),
        ({"background": [2, 1, 1]}, "background[0]: "),
        ({"background": "environment"}, "the light is baked"),
        ({"path": {"kind": "fly"}}, "path.kind: "),
        ({"path": {"kind": "around", "radius": 0.5}}, "runs into the mesh at ["),
        ({"path": {"kind": "around", "radius": 0.8}}, "comes within 0.0"),
        ({"path": {"kind": "around", "radius": 1e30}}, "path.radius: "),
        ({"path": {"kind": "around", "turns": 1e9}}, "path.turns: "),
        ({"path": {"kind": "around", "duration": 1e300}}, "path.duration: "),
        ({"path": {"kind": "around", "center": [0, 0, 1e30]}}, "path.center[2]: "),
        ({"path": {"kind": "walk", "positions": [[0, 0, 0]], "targets": [[0, 0, 0]]}}, "path.positions: "),
        ({"path": {**WALK, "positions": [[0, 0, 0]] * 20_000}}, "path.positions: "),
        ({"path": {**WALK, "positions": WALK["targets"]}}, "straight up or down"),
        ({"path": {**WALK, "positions": WALK["positions"][:3] + WALK["positions"][:1]}}, "are the same"),
        ({"path": WALK, "box": [[0, 0, 0], [1, 1, 1]]}, "inside its scene"),
        ({"box": [[0, 0, 0], [1, 1, 0]]}, "box is"),
    ],
)
def test_refuse_scene_file(box_file: Path, values: dict, problem: str) -> None:
    with pytest.raises(DataError) as raised:
        open_scene(scene_file(box_file, **values))
    assert problem in str(raised.value)


def test_blender_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene.blend").touch()
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(DataError, match=r"scene\.blend: .*pip install 'aenerf-ns\[blender\]', in Python 3\.11"):
        open_scene(str(tmp_path / "scene.blend"))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", ["-Y 8 +X 16", "-Y 1000000 +X 2000000"])
def test_refuse_panorama_without_pixels(
    size: str, box_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("OPENCV_TEMP_PATH", str(tmp_path / "temporary"))
    box_file.with_name("e.hdr").write_bytes(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{size}\n".encode())
    with pytest.raises(DataError, match="not a Radiance picture"):
        open_scene(scene_file(box_file, light={"environment": "e.hdr"}))
    assert not capfd.readouterr().err
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize("path", [{"kind": "around", "radius": 1.1}, WALK], ids=["around", "walk"])
def test_views_are_free_and_seeded(box_file: Path, path: dict) -> None:
    obstacle = trimesh.creation.icosphere(2, 0.25)
    scene_mesh = trimesh.Scene([painted_box()])
    # Beside the walk, and on the sphere of the views around.
    place = (0.0, 1.85, 0.5) if path is WALK else paths.ObjectPath(radius=1.1).validation_views(10)[2][:3, 3]
    scene_mesh.add_geometry(obstacle, transform=trimesh.transformations.translation_matrix(place))
    scene_mesh.export(box_file)
    if path is not WALK:
        path = {**path, "turns": 0.5, "center": [0, 0, 0]}
    scene = open_scene(scene_file(box_file, path=path))
    validation, test = scene.path.validation_views(10), scene.path.test_views(60, 5)
    assert validation.shape == (10, 4, 4)
    np.testing.assert_array_equal(test, scene.path.test_views(60, 5))
    assert not np.array_equal(test, scene.path.test_views(60, 6))
    on_path = np.stack([scene.path(s) for s in np.linspace(0, 1, 2000)])[:, :3]
    distance = scene.renderer.caster.distance
    clearance = min(0.15, 0.13 * 1.1)
    for pose in [*validation, *test]:
        assert np.abs(on_path - pose[:3]).max((1, 2)).min() > 1e-3
        assert distance(pose[:3, 3])[0] >= clearance - 1e-4


def test_materials_get_coats(box_file: Path) -> None:
    diffuse, shiny = (
        open_scene(scene_file(box_file, light=DAY, **more)) for more in ({}, {"materials": {"paint": TIN}})
    )
    np.testing.assert_array_equal(diffuse.renderer.light, shiny.renderer.light)
    assert diffuse.renderer.reflections is None
    np.testing.assert_allclose(shiny.renderer.reflections.specular, 0.5)
    np.testing.assert_allclose(shiny.renderer.reflections.lobe, np.sqrt(2) * 0.04, rtol=1e-6)
    pose, intrinsics = shiny.path(0.99), shiny.intrinsics(64, 48)  # from above, where the lamp is mirrored
    before, after = (scene.renderer.render(pose, intrinsics, 64, 48, 4)[0] for scene in (diffuse, shiny))
    assert after.max() == pytest.approx(1, abs=1e-4)
    assert before.max() < 0.95
    # Exposure scales lamps and sky alike. The sky's uppermost texel is a little darker than its zenith.
    reflections = shiny.renderer.reflections
    assert reflections.lamps[0, 3] == pytest.approx(9 * reflections.environment.texels.max(), rel=2e-3)


def test_bare_mesh_is_in_view(tmp_path: Path) -> None:
    body = trimesh.creation.box((40.0, 90.0, 20.0))
    body.apply_translation((1000.0, 0, 0))
    body.export(tmp_path / "box.ply")
    scene = open_scene(str(tmp_path / "box.ply"))
    assert len(scene.notes) == 1
    assert "scaled by 0.02" in scene.notes[0]
    brightest = 0.0
    for pose in [*(scene.path(k / 9) for k in range(10)), *scene.path.test_views(10, 0)]:
        radiance, depth = scene.renderer.render(pose, scene.intrinsics(60, 45), 60, 45, 1)
        hit = np.isfinite(depth)
        assert 0.02 < hit.mean() < 0.6
        brightest = max(brightest, radiance[hit].max())
        directions = ray_directions(scene.intrinsics(60, 45), 60, 45)[hit]
        points = directions * depth[hit][:, None] @ pose[:3, :3].T + pose[:3, 3]
        assert (points > scene.aabb[0]).all()
        assert (points < scene.aabb[1]).all()
    assert 0.8 < brightest < 1
    for s in np.linspace(0, 1, 20):
        depth = scene.renderer.render(scene.path(s), scene.intrinsics(60, 45), 60, 45, 4)[1]
        assert np.isinf([*depth[0], *depth[-1], *depth[:, 0], *depth[:, -1]]).all()


def test_a_scene_without_an_event_is_refused(box_file: Path) -> None:
    name = scene_file(box_file, path={"kind": "around", "radius": 2.5, "turns": 0.2})
    thresholds = {"positive_contrast_threshold": 900.0, "negative_contrast_threshold": 900.0}
    with pytest.raises(DataError, match="no pixel changes by a contrast threshold; give lower thresholds, or a scene"):
        Simulate(box_file.with_name("data"), scene=name, width=24, height=18, duration=0.1, **thresholds).main()
    assert not box_file.with_name("data").exists()


def test_command_events_are_thresholds_apart(box_file: Path) -> None:
    """The command, on a mesh: at every event, the log-radiance that the renderer gives has moved by one threshold."""
    name = scene_file(box_file, path={"kind": "around", "radius": 2.5, "turns": 0.2})
    output = box_file.with_name("data")
    Simulate(output, scene=name, width=24, height=18, duration=1.0, max_displacement=1.0, train_images=1,
             validation_views=1, test_views=1).main()  # fmt: skip
    with h5py.File(output / "events.h5") as file:
        x, y, t, p = (file[f"events/{key}"][:] for key in "xytp")
    scene = open_scene(name)
    intrinsics = scene.intrinsics(24, 18)
    frames = frame_parameters(scene, intrinsics, 24, 18, 1.0)
    pictures = np.stack([scene.renderer.render(scene.path(s), intrinsics, 24, 18, RAYS_PER_PIXEL)[0] for s in frames])
    level = np.log((pictures * LUMINANCE).sum(-1, dtype=np.float64) + 1e-3)
    times = np.rint(frames * 1e9)
    pixels = 0
    for row, column in np.ndindex(18, 24):
        mine = (x == column) & (y == row)
        if mine.any():
            moved = np.interp(t[mine], times, level[:, row, column]) - level[0, row, column]
            # A time stamp is rounded to whole nanoseconds: so far the log-radiance moves meanwhile.
            slope = np.diff(level[:, row, column]) / np.diff(times)
            rounding = 0.5 * np.abs(slope[np.searchsorted(times, t[mine]) - 1])
            assert (np.abs(moved - 0.25 * np.cumsum(p[mine].astype(np.int64))) - rounding).max() < 1e-6
            pixels += 1
    assert pixels > 50
    assert json.loads((output / "transforms.json").read_text())["scene_box"][1][0] == pytest.approx(0.63, abs=1e-3)
