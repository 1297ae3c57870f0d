"""Scenes of Blender, up to the events. Blender writes the files that it then renders."""

import json
import os
import signal
import threading
import time
from collections import deque
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.small_meshes import OVERHEAD, WALK
from PIL import Image

from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.cli.termination import sigterm_as_system_exit
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.simulator import simulation
from aenerf_ns.simulator.blender import BlenderRenderer
from aenerf_ns.simulator.esim import EventSimulator
from aenerf_ns.simulator.open_scene import open_scene

bpy: Any = pytest.importorskip("bpy", reason="needs Blender's package (pip install 'aenerf-ns[blender]')")

FLYING_ROOM = Path(__file__).parents[2].parent / "shared/data/esim_flying_room/flying_room.blend"
LENS = 20.0, 20.0, 15.0, 8.0


@pytest.fixture
def blend(tmp_path: Path) -> Path:
    """A glowing quarter of the plane z = 1, right of and above the origin, on a gray floor under a gray sky."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    add_plate("glowing", [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], "ShaderNodeEmission", (0.1, 0.2, 0.8, 1))
    add_plate("floor", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], "ShaderNodeBsdfDiffuse", (0.5, 0.5, 0.5, 1))
    scene.world = bpy.data.worlds.new("sky")
    # These settings are for pictures that people look at. They must not change radiance.
    scene.view_settings.view_transform, scene.view_settings.exposure = "AgX", 3.0
    scene.render.use_stamp = scene.render.use_freestyle = True
    scene.render.resolution_x, scene.render.resolution_y = 200, 100
    return saved(tmp_path)


def saved(folder: Path) -> Path:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    return folder / "scene.blend"


def add_plate(name: str, corners: list[tuple[float, ...]], shader: str, color: tuple[float, ...]) -> Any:
    mesh, material = bpy.data.meshes.new(name), bpy.data.materials.new(name)
    mesh.from_pydata(corners, [], [range(4)])
    nodes = material.node_tree.nodes
    nodes.clear()
    surface = nodes.new(shader)
    surface.inputs["Color"].default_value = color
    material.node_tree.links.new(surface.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    return surface


def animate(**lens: object) -> None:
    """A camera that slides by 2 m in 1.5 s and looks down, on a parent of twice the size."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("walker")
    camera, parent = bpy.data.objects.new("walker", data), bpy.data.objects.new("parent", None)
    for item in (camera, parent):
        scene.collection.objects.link(item)
    camera.parent, scene.camera, parent.scale = parent, camera, (2, 2, 2)
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", 30, 45
    for name, value in lens.items():
        setattr(data, name, value)
    scene.frame_start, scene.frame_end, scene.render.fps = 11, 26, 10
    for frame, x in ((11, -0.5), (26, 0.5)):
        camera.location = (x, 0.25, 1.5)
        camera.keyframe_insert("location", frame=frame)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_radiance_and_depth(blend: Path, scale: float) -> None:
    renderer = BlenderRenderer(blend, scale)
    pose = OVERHEAD.copy()
    pose[2, 3] *= scale
    radiance, depth = renderer.render(pose, LENS, 32, 3, 1)
    x = (np.arange(32) + 0.5 - 15) / 20 * 2
    y = -(np.arange(3)[:, None] + 0.5 - 8) / 20 * 2
    glows = (x > 0) & (x < 1) & (y > 0) & (y < 1)
    assert 20 < glows.sum() < 60
    np.testing.assert_array_equal(depth, np.where(glows, np.float32(2 * scale), np.float32(3 * scale)).round(6))
    np.testing.assert_allclose(radiance[glows], np.broadcast_to([0.1, 0.2, 0.8], (glows.sum(), 3)), rtol=1e-5)
    up = pose @ np.diag([1, -1, -1, 1])
    for samples in (1, 16):
        radiance, depth = renderer.render(up, LENS, 32, 3, samples)
        assert np.isinf(depth).all()
        # Denoising leaves an even sky as it is, up to the rim.
        np.testing.assert_allclose(radiance, radiance[0, 0].mean(), rtol=0.01)
    np.testing.assert_allclose(renderer.bounds, [[-9 * scale, -9 * scale, 0], [9 * scale, 9 * scale, scale]])
    assert renderer.distance([[0, 0, -4 * scale]]) == pytest.approx(4 * scale)
    assert renderer.blocked(np.array([[0, 0, 2, 0, 0, -3], [0, 0, 2, 0, 0, -0.5]]) * scale).tolist() == [1, 0]


def test_still_camera_fires_no_events(blend: Path) -> None:
    """The floor is lit by the glowing plate, so its radiance has noise. It must be the same noise in each frame."""
    renderer, simulator = BlenderRenderer(blend, seed=1), EventSimulator(32, 24, SensorModel(0.01, 0.01))
    for k in range(3):
        picture = renderer.render(OVERHEAD, LENS, 32, 24, 16)[0]
        assert len(simulator(picture, k * 10**6)) == 0
        renderer.render(OVERHEAD, LENS, 8, 6, 1)
    other = BlenderRenderer(blend, seed=2).render(OVERHEAD, LENS, 32, 24, 16)[0]
    assert 0 < np.abs(other - picture).max() < 0.1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt(blend: Path, number: int) -> None:
    """Blender's own Python code, in the middle of a rendering, must not be what takes the exception."""
    renderer = BlenderRenderer(blend)
    renderer.render(OVERHEAD, LENS, 96, 72, 16)
    end = time.monotonic() + 30
    in_time = takewhile(lambda _: time.monotonic() < end, count())
    pictures = (renderer.render(OVERHEAD, LENS, 96, 72, 16) for _ in in_time)
    threading.Timer(0.3, os.kill, (os.getpid(), number)).start()
    with sigterm_as_system_exit(), pytest.raises((KeyboardInterrupt, SystemExit)):
        deque(pictures, maxlen=0)


def test_follow_camera(blend: Path) -> None:
    animate()
    scene = open_scene(str(saved(blend.parent)))
    assert scene.duration == 1.5
    assert scene.focal_ratio == pytest.approx(1.5)
    assert scene.aabb is None
    np.testing.assert_allclose(scene.path(0), [[1, 0, 0, -1], [0, -1, 0, 0.5], [0, 0, -1, 3], [0, 0, 0, 1]], atol=1e-6)
    middle = scene.path(0.5)
    assert middle[0, 3] == pytest.approx(0, abs=1e-3)
    assert "'walker', frames 11 to 26 at 10 frames" in scene.notes[0]
    views = np.concatenate([scene.path.validation_views(5), scene.path.test_views(5, 0)])
    aside = np.abs(views[:, 1:3, 3] - [0.5, 3]).max(axis=1)
    assert 1e-3 < np.median(aside) < aside.max() < 0.2
    # The gaze is turned about the vertical, so that it still goes down.
    assert views[:, 2, 2].max() < -0.999
    assert views[:, 0, 0].min() < 0.999


@pytest.mark.parametrize(
    ("lens", "problem"),
    [({"type": "ORTHO"}, "type ORTHO"), ({"shift_x": 0.3}, "is shifted by"), ({"lens": "zoom"}, "its lens changes")],
)
def test_refuse_camera(blend: Path, lens: dict, problem: str) -> None:
    animate(**({} if "lens" in lens else lens))
    if lens.get("lens") == "zoom":
        data = bpy.context.scene.camera.data
        for frame, focal in ((11, 45), (26, 60)):
            data.lens = focal
            data.keyframe_insert("lens", frame=frame)
    saved(blend.parent)
    with pytest.raises(DataError, match=problem):
        open_scene(str(blend))
    # A path of one's own needs no camera.
    (blend.parent / "scene.json").write_text(json.dumps({"mesh": blend.name, "path": WALK, "scale": 4}))
    assert open_scene(str(blend.parent / "scene.json")).focal_ratio == 0.62


def test_a_marker_that_switches_to_another_camera(blend: Path) -> None:
    animate()
    scene, other = bpy.context.scene, bpy.data.objects.new("other", bpy.data.cameras.new("other"))
    scene.collection.objects.link(other)
    for frame, camera in ((11, other), (15, scene.camera)):
        scene.timeline_markers.new("cut", frame=frame).camera = camera
    saved(blend.parent)
    with pytest.raises(DataError, match="the camera or its lens changes"):
        BlenderRenderer(blend)
    depth = BlenderRenderer(blend, follow=False).render(OVERHEAD, LENS, 32, 3, 1)[1]
    assert {*depth.ravel().round(5).tolist()} == {2, 3}


def test_textures(blend: Path, tmp_path: Path) -> None:
    def add_texture(name: str) -> None:
        nodes = bpy.data.materials["floor"].node_tree.nodes
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.load(str(tmp_path / "elsewhere" / name))

    (tmp_path / "elsewhere").mkdir()
    for name in ("brick.png", "unused.png"):
        Image.new("RGB", (2, 2)).save(tmp_path / "elsewhere" / name)
    add_texture("brick.png")
    bpy.data.images.load(str(tmp_path / "elsewhere/unused.png")).use_fake_user = True
    saved(tmp_path)
    (tmp_path / "elsewhere/unused.png").unlink()
    BlenderRenderer(blend)
    (tmp_path / "elsewhere").rename(tmp_path / "textures")
    BlenderRenderer(blend)
    (tmp_path / "textures/brick.png").unlink()
    with pytest.raises(DataError, match=r"files that it uses are missing: .*brick\.png;") as raised:
        BlenderRenderer(blend)
    assert "unused" not in str(raised.value)


def test_a_linked_object_is_found_and_a_hidden_collection_is_an_obstacle(blend: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    collection = bpy.data.collections.new("hidden by the eye")
    bpy.context.scene.collection.children.link(collection)
    add_plate("wall", [(0, 5, 0), (9, 5, 0), (9, 5, 9), (0, 5, 9)], "ShaderNodeEmission", (1, 1, 1, 1))
    wall = bpy.data.objects["wall"]
    collection.objects.link(wall)
    bpy.context.scene.collection.objects.unlink(wall)
    bpy.context.view_layer.layer_collection.children[0].hide_viewport = True
    bpy.data.libraries.write(str(folder / "tower.blend"), {bpy.data.objects["glowing"]})
    bpy.data.objects.remove(bpy.data.objects["glowing"])
    with bpy.data.libraries.load(str(folder / "tower.blend"), link=True) as (_, linked):
        linked.objects = ["glowing"]
    bpy.context.scene.collection.objects.link(bpy.data.objects["glowing"])
    saved(tmp_path)
    for name in ("elsewhere", "moved"):
        renderer = BlenderRenderer(blend)
        assert renderer.bounds[1, 2] == pytest.approx(9)
        assert renderer.blocked(np.array([[0.5, 0.5, 2, 0, 0, -1.5], [4, 0, 4, 0, 8, 0]])).tolist() == [1, 1]
        if name == "elsewhere":
            folder.rename(tmp_path / "moved")
    (tmp_path / "moved/tower.blend").unlink()
    with pytest.raises(DataError, match=r"files that it uses are missing: .*tower\.blend;"):
        BlenderRenderer(blend)


def test_refuse_file(tmp_path: Path) -> None:
    broken = tmp_path / "broken.blend"
    broken.write_bytes(b"BLENDER")
    with pytest.raises(DataError, match="Blender cannot open it"):
        open_scene(str(broken))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with pytest.raises(DataError, match="no surfaces"):
        open_scene(str(saved(tmp_path)))
    add_plate("dark", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "ShaderNodeBsdfDiffuse", (1, 1, 1, 1))
    with pytest.raises(DataError, match="no light reaches"):
        open_scene(str(saved(tmp_path)))


def test_refuse_light_in_scene_file(blend: Path) -> None:
    file = blend.parent / "scene.json"
    file.write_text(json.dumps({"mesh": blend.name, "light": "baked"}))
    with pytest.raises(DataError, match=r"light is given, but a \.blend has its own"):
        open_scene(str(file))


@pytest.mark.parametrize("transparent", [False, True])
def test_command(blend: Path, transparent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """An object that stands alone, seen from around it."""
    monkeypatch.setattr(simulation, "RAYS_PER_PIXEL", 1)  # 100 frames, without noise
    bpy.data.objects["floor"].hide_render = True
    bpy.context.scene.render.film_transparent = transparent
    saved(blend.parent)
    file, output = blend.parent / "scene.json", blend.parent / "data"
    path = {"kind": "around", "turns": 0.25, "radius": 3, "center": [0.5, 0.5, 1]}
    file.write_text(json.dumps({"mesh": blend.name, "path": path, "focal_ratio": 2}))
    Simulate(output, scene=str(file), width=24, height=18, max_displacement=2.0, train_images=2, validation_views=1,
             test_views=1).main()  # fmt: skip
    meta = json.loads((output / "transforms.json").read_text())
    assert meta["event_camera"]["fl_x"] == 48
    assert ("scene_box" in meta) == transparent
    with h5py.File(output / "events.h5") as events:
        assert len(events["events/t"]) > 100
    # The last picture on the path sees the object from above. Where the film is transparent, gray is behind it.
    picture = np.asarray(Image.open(output / meta["frames"][1]["file_path"])) / 255
    assert (picture[0, 0, 0] == pytest.approx(0.735, abs=0.01)) == transparent
    assert abs(picture[9, 12, 0] - picture[0, 0, 0]) > 0.1


@pytest.mark.skipif(not FLYING_ROOM.exists(), reason="needs ESIM's flying room in ../shared/data")
def test_flying_room() -> None:
    scene = open_scene(str(FLYING_ROOM))
    assert "2.79 or older: Texture, Texture.001, carpet_texture, leaves, rocks" in scene.notes[0]
    assert "seen from around it" in scene.notes[1]
    radiance, depth = scene.renderer.render(scene.path(0.3), scene.intrinsics(32, 24), 32, 24, 16)
    assert radiance.std() > 0.02
    assert np.isfinite(depth).any()
