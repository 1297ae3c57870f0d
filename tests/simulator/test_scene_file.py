"""Meshes and scene.json files as scenes, up to the events."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.small_meshes import (
    WALK,
    painted_box,
    ray_directions,
    scene_file,
)

from aenerf_ns.camera.image_encoding import LUMINANCE
from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.errors import DataError
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.frames import frame_parameters
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.simulation import RAYS_PER_PIXEL

pytestmark = pytest.mark.usefixtures("small_work")

TIN = {"specular": 0.5, "roughness": 0.2}
DAY = {"sky": [[0, 0, 0], [1, 1, 1]], "lamps": [
    {"center": [0, 0, 3], "half_u": [1, 0, 0], "half_v": [0, -1, 0], "radiance": [9, 9, 9]}]}  # fmt: skip


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"mesh": "gone.glb"}, "gone.glb: the file does not exist"),
        ({"mesh": "scene.json"}, "unknown kind of mesh '.json'"),
        ({"mesh": 3}, "mesh is 3, not of type str"),
        ({"up": "x"}, 'up is "x"; give "y" or "z"'),
        ({"mesh": "../box.glb"}, "it names ../box.glb, outside the folder"),
        ({"mesh": "m" * 5000 + ".glb"}, "cannot be read (File name too long)"),
        ({"scale": -1}, "scale is -1; give a number from 1e-06 to 1e+06"),
        ({"scale": 1e300}, "scale is 1e+300; give a number from"),
        ({"focal_ratio": 1e300}, "focal_ratio is 1e+300; give a number from 0.01 to 100"),
        ({"path": {"kind": "around", "radius": 1e30}}, "radius is 1e+30; give a number from"),
        ({"path": {"kind": "around", "turns": 1e9}}, "turns is 1e+09; give a number from 0.001 to 1000"),
        ({"path": {"kind": "around", "duration": 1e300}}, "duration is 1e+300; give a number from 0.001 to 100000"),
        ({"path": {"kind": "around", "center": [0, 0, 1e30]}}, "center has 1e+30; give numbers up to 1e+06"),
        ({"path": {**WALK, "positions": [[0, 0, 0]] * 20_000}}, "positions has 20000 rows; give at most 10000"),
        ({"light": {"sky": [[1] * 3, [1e300] * 3]}}, "light.sky has 1e+300; give numbers up to 1e+06"),
        ({"light": {**DAY, "lamps": DAY["lamps"] * 101}}, "light.lamps has 101 entries; give at most 100"),
        ({"light": {**DAY, "lamps": [{**DAY["lamps"][0], "half_v": [0, 0, 0]}]}}, "half_u spans no rectangle with"),
        ({"color": 1}, "unknown key 'color'"),
        ({"light": "bright"}, 'light is "bright"; give "baked"'),
        ({"light": {}}, 'light has none or both of "sky" and "environment"'),
        ({"light": {"sky": [[1, 1, 1]]}}, "light.sky must be 2 x 3 finite numbers, not [[1, 1, 1]]"),
        ({"light": {"sky": [[1, 1, 1], [1, 1, -1]]}}, "must not be negative"),
        ({"light": {"environment": "gone.hdr"}}, "gone.hdr: the environment does not exist"),
        ({"light": {"environment": "box.glb"}}, "box.glb: not a Radiance picture"),
        ({"light": {"sky": [[0] * 3, [1] * 3], "lamps": [{"center": [0, 0, 1]}]}}, "light.lamps[0].half_u is missing"),
        ({"light": {"sky": [[0] * 3, [1] * 3], "lamps": [3]}}, "light.lamps[0] is 3, not an object"),
        ({"light": DAY, "materials": {"tin": TIN}}, "no surface has the material 'tin'; the file has paint"),
        ({"light": DAY, "materials": {"paint": {"specular": 0.5}}}, "materials.paint.roughness is missing"),
        ({"light": DAY, "materials": {"paint": {**TIN, "specular": 50}}}, "specular is 50; give a number from 0 to 1"),
        ({"light": DAY, "materials": {"paint": {**TIN, "roughness": 1}}}, "is 1; give a number from 0 to 0.5"),
        ({"light": DAY, "materials": {"paint": {**TIN, "shine": 1}}}, "unknown key 'materials.paint.shine'"),
        ({"light": DAY, "materials": ["paint"]}, 'materials is ["paint"], not of type dict'),
        ({"materials": {"paint": TIN}}, "materials with baked light"),
        ({"background": [1, 1]}, "background must be 3 finite numbers, not [1, 1]"),
        ({"background": [2, 1, 1]}, "at most 1"),
        ({"background": "environment"}, "the light is baked"),
        ({"path": {"kind": "fly"}}, 'path.kind is "fly"; give "around" or "walk"'),
        ({"path": {"kind": "around", "radius": 0.5}}, "runs into the mesh at ("),
        ({"path": {"kind": "around", "radius": 0.8}}, "comes within 0.0"),
        ({"path": {"kind": "around", "speed": 1}}, "unknown key 'path.speed'; known keys are center, duration"),
        ({"path": {"kind": "walk", "positions": [[0, 0, 0]], "targets": [[0, 0, 0]]}}, "at least 4"),
        ({"path": {**WALK, "positions": WALK["targets"]}}, "straight up or down"),
        ({"path": {**WALK, "positions": WALK["positions"][:3] + WALK["positions"][:1]}}, "are the same"),
        ({"path": WALK, "box": [[0, 0, 0], [1, 1, 1]]}, "box with a walk"),
        ({"box": [[0, 0, 0], [1, 1, 0]]}, "box is"),
    ],
)  # fmt: skip
def test_bad_scene_files_end_in_one_line(box_file: Path, values: dict, told: str) -> None:
    with pytest.raises(DataError) as raised:
        open_scene(scene_file(box_file, **values))
    message = str(raised.value)
    assert told in message
    assert "\n" not in message


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


# A warning of a library would print a second line.
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.obj", f"mtllib \n{TRIANGLE}"),
        ("m.obj", f"usemtl \n{TRIANGLE}"),
        ("m.obj", f"mtllib {'m' * 5000}\n{TRIANGLE}"),
        ("m.obj", f"mtllib .\n{TRIANGLE}"),
        ("m.obj", TRIANGLE.replace("3\n", "99\n")),
        ("m.obj", TRIANGLE.replace("v 1", "v inf")),
        ("m.ply", "ply\n"),
        ("m.glb", ""),
    ],
)
def test_a_malformed_mesh_is_one_line(name: str, content: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError) as raised:
        open_scene(str(tmp_path / name))
    assert "\n" not in str(raised.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", ["-Y 8 +X 16", "-Y 1000000 +X 2000000"])
def test_a_panorama_without_its_pixels_is_one_line(
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
def test_views_are_off_the_path_seeded_and_free(box_file: Path, path: dict) -> None:
    obstacle = trimesh.creation.icosphere(2, 0.25)
    scene_mesh = trimesh.Scene([painted_box()])
    # Beside the walk, and on the sphere of the views around.
    place = (0.0, 1.85, 0.5) if path is WALK else paths.object_validation_views(10, 1.1)[2][:3, 3]
    scene_mesh.add_geometry(obstacle, transform=trimesh.transformations.translation_matrix(place))
    scene_mesh.export(box_file)
    if path is not WALK:
        path = {**path, "turns": 0.5, "center": [0, 0, 0]}
    scene = open_scene(scene_file(box_file, path=path))
    validation, test = scene.validation_views(10), scene.test_views(60, 5)
    assert validation.shape == (10, 4, 4)
    np.testing.assert_array_equal(test, scene.test_views(60, 5))
    assert not np.array_equal(test, scene.test_views(60, 6))
    on_path = np.stack([scene.path(s) for s in np.linspace(0, 1, 2000)])[:, :3]
    distance = scene.renderer.caster.distance
    clearance = min(0.15, 0.13 * 1.1)
    for pose in [*validation, *test]:
        assert np.abs(on_path - pose[:3]).max((1, 2)).min() > 1e-3
        assert distance(pose[:3, 3])[0] >= clearance - 1e-4


def test_materials_get_their_coats_and_keep_their_exposure(box_file: Path) -> None:
    diffuse, shiny = (
        open_scene(scene_file(box_file, light=DAY, **more)) for more in ({}, {"materials": {"paint": TIN}})
    )
    np.testing.assert_array_equal(diffuse.renderer.light, shiny.renderer.light)
    assert diffuse.renderer.reflections is None
    assert shiny.renderer.reflections is not None
    np.testing.assert_allclose(shiny.renderer.reflections.coats.specular, 0.5)
    np.testing.assert_allclose(shiny.renderer.reflections.coats.lobe, np.sqrt(2) * 0.04, rtol=1e-6)
    pose, intrinsics = shiny.path(0.99), shiny.intrinsics(64, 48)  # from above, where the lamp is mirrored
    before, after = (scene.renderer.render(pose, intrinsics, 64, 48, 4)[0] for scene in (diffuse, shiny))
    assert after.max() == pytest.approx(1, abs=1e-4)
    assert before.max() < 0.95
    # Exposure scales lamps and sky alike. The sky's uppermost texel is a little darker than its zenith.
    assert shiny.renderer.reflections.lamps[0, 3] == pytest.approx(
        9 * shiny.renderer.reflections.environment.texels.max(), rel=2e-3
    )


def test_a_bare_mesh_is_an_object_in_view(tmp_path: Path) -> None:
    body = trimesh.creation.box((40.0, 90.0, 20.0))
    body.apply_translation((1000.0, 0, 0))
    body.export(tmp_path / "box.ply")
    scene = open_scene(str(tmp_path / "box.ply"))
    assert len(scene.notes) == 1
    assert "scaled by 0.02" in scene.notes[0]
    assert scene.aabb is not None
    brightest = 0.0
    for pose in [*(scene.path(k / 9) for k in range(10)), *scene.test_views(10, 0)]:
        radiance, depth, alpha = scene.renderer.render(pose, scene.intrinsics(60, 45), 60, 45, 4)
        assert 0.02 < alpha.mean() < 0.6
        hit = alpha == 1
        brightest = max(brightest, radiance[hit].max())
        points = (
            ray_directions(scene.intrinsics(60, 45), 60, 45)[hit] * depth[hit][:, None] @ pose[:3, :3].T + pose[:3, 3]
        )
        assert (points > scene.aabb[0]).all()
        assert (points < scene.aabb[1]).all()
    assert 0.8 < brightest < 1
    for s in np.linspace(0, 1, 20):
        alpha = scene.renderer.render(scene.path(s), scene.intrinsics(60, 45), 60, 45, 4)[2]
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0


def test_simulated_events_are_thresholds_apart(box_file: Path) -> None:
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
