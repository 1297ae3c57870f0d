"""Read scenes from files: a scene.json with a mesh, its light and the camera's path, or a mesh alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from aenerf_ns.errors import DataError
from aenerf_ns.files.json_object import JsonObject
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.free_space import FreeSpace
from aenerf_ns.simulator.options import DURATIONS, MESH_SUFFIXES, require_scene_file
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.rendering.environment import Environment, load_environment, sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, baked_mesh, light_mesh
from aenerf_ns.simulator.rendering.mesh import Gloss, Mesh, scaled
from aenerf_ns.simulator.rendering.mesh_loading import load_mesh
from aenerf_ns.simulator.rendering.mesh_repair import prepared
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.scene import SimulationScene

CLEARANCE = 0.15
"""Distance in meters that cameras keep from a mesh; less along a path of less than about a meter."""
_FOCAL_RATIO = {"around": 1.2, "walk": 0.62}
_SKY = [[0.25, 0.25, 0.25], [1.0, 1.0, 1.0]]
_BACKGROUND = [0.5, 0.5, 0.5]
_RADIUS = 4.0
_RADII = 3.6
"""Default distance of the camera from an object: in meters, and in half diagonals of the object's bounds."""
_DURATION = 4.0
_ROUGHEST = 0.5
"""Highest roughness. The narrow lobe that reflections assume does not describe rougher surfaces."""
_BRIGHTEST = 0.9
"""Radiance that the brightest surface in probes of the path is scaled to, with room for brighter ones between them."""

# Wider than any scene needs. Beyond them float32, in which rays are traced, overflows, or the work never ends.
_SCALES, _FOCAL_RATIOS, _TURNS = (1e-6, 1e6), (0.01, 100.0), (1e-3, 1000.0)
_LARGEST, _MOST_LAMPS, _MOST_KNOTS = 1e6, 100, 10_000

_KEYS = {"mesh", "up", "scale", "materials", "light", "background", "path", "focal_ratio", "box", "credits"}
_PATH_KEYS = {
    "around": {"kind", "center", "radius", "turns", "duration"},
    "walk": {"kind", "positions", "targets", "duration"},
}
_REMEDY = "see docs/simulator.md"


@dataclass(frozen=True)
class _Views:
    path: Callable[[float], Array]
    validation: Callable[[int], Array]
    test: Callable[[int, int], Array]


def load_scene(path: Path, seed: int = 0) -> SimulationScene:
    """Read and light a mesh, with a scene.json or by itself.

    Args:
        path: a .json, .glb, .obj or .ply file.
        seed: seed of the sampling of light.

    Raises:
        DataError: a file is missing or malformed, or the camera's path runs into the mesh.
    """
    require_scene_file(path)
    is_bare = path.suffix.lower() in MESH_SUFFIXES
    if is_bare:
        values = JsonObject(path, {"mesh": path.name}, remedy=_REMEDY)
    else:
        values = JsonObject.read(path, _REMEDY)
        values.refuse_keys_except(_KEYS)
    file = values.file("mesh")
    up = values.choice("up", ("y", "z"), "y" if file.suffix.lower() == ".glb" else "z")
    scale = values.number("scale", *_SCALES, 1.0)
    light = _light(values)
    gloss = _gloss(values, light is None)
    background = _background(values, light)
    route = values.block("path") if "path" in values else JsonObject(path, {"kind": "around"}, remedy=_REMEDY)
    kind = route.choice("kind", tuple(_PATH_KEYS))
    route.refuse_keys_except(_PATH_KEYS[kind])
    duration = route.number("duration", *DURATIONS, _DURATION)
    focal_ratio = values.number("focal_ratio", *_FOCAL_RATIOS, _FOCAL_RATIO[kind])
    box = _box(values, kind)

    mesh = load_mesh(file, up == "y", gloss)
    if is_bare:
        scale = _half_diagonal_scale(mesh)
    try:
        mesh, coincident = prepared(scaled(mesh, scale))
    except ValueError as error:
        raise DataError(file, str(error), "give a mesh of triangles") from error
    bounds = np.stack([mesh.vertices[mesh.faces].min(axis=(0, 1)), mesh.vertices[mesh.faces].max(axis=(0, 1))])
    if box is None and kind == "around" and background is not None:
        box = bounds + 0.025 * np.diff(bounds, axis=0) * [[-1], [1]]
    notes = []
    if is_bare:
        notes.append(
            f"{path}: seen from {_RADIUS:g} m around it, under a plain sky, {up} up, scaled by {scale:.4g} to "
            f"{' x '.join(f'{side:.2f}' for side in np.diff(bounds, axis=0)[0])} m (a scene.json can say otherwise)"
        )
    if coincident:
        notes.append(f"{file}: {coincident} faces coincide with others; where they do, the first in the file is seen")

    caster = RayCaster(mesh.vertices, mesh.faces)
    views = _views(route, kind, bounds, caster)
    behind = np.zeros(3) if background is None else background
    if light is None:
        renderer = baked_mesh(mesh, caster, behind)
    else:
        renderer = light_mesh(mesh, caster, *light, behind, show_environment=background is None, seed=seed)
    scene = SimulationScene(
        path.stem,
        renderer,
        views.path,
        focal_ratio=focal_ratio,
        aabb=box,
        background=background,
        validation_views=views.validation,
        test_views=views.test,
        duration=duration,
        notes=tuple(notes),
    )
    return scene if light is None else replace(scene, renderer=_exposed(scene, renderer))


def _half_diagonal_scale(mesh: Mesh) -> float:
    """Return the scale that brings a mesh's bounds into view from the default distance."""
    corners = mesh.vertices[mesh.faces]
    half_diagonal = 0.5 * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    return _RADIUS / (_RADII * half_diagonal) if half_diagonal > 0 else 1.0


def _light(values: JsonObject) -> tuple[Environment, list[AreaLight]] | None:
    """Return the environment and the lamps, or None for baked light."""
    if "light" not in values:
        return sky(*np.array(_SKY)), []
    if not values.holds("light", dict):
        values.choice("light", ("baked",))
        return None
    light = values.block("light")
    if ("sky" in light) == ("environment" in light):
        raise values.error("light", 'has none or both of "sky" and "environment"', "give one")
    light.refuse_keys_except({"sky", "lamps"} if "sky" in light else {"environment", "turn_degrees", "gain", "lamps"})
    if "sky" in light:
        environment = sky(*_radiance(light, "sky", (2, 3)))
    else:
        file = light.file("environment")
        environment = load_environment(
            file, light.number("turn_degrees", -360, 360, 0.0), light.number("gain", *_SCALES, 1.0)
        )
    num_lamps = len(light.get("lamps", list, []))
    if num_lamps > _MOST_LAMPS:
        raise light.error("lamps", f"has {num_lamps} entries", f"give at most {_MOST_LAMPS}")
    return environment, [_lamp(light.entry_block("lamps", i)) for i in range(num_lamps)]


def _gloss(values: JsonObject, is_baked: bool) -> dict[str, Gloss]:
    """Return the coats of materials by their names."""
    materials = values.block("materials") if "materials" in values else JsonObject(values.path, {})
    coats = {}
    for name in values.get("materials", dict, {}):
        material = materials.block(name)
        material.refuse_keys_except(Gloss._fields)
        coats[name] = Gloss(_number_up_to(material, "specular", 1.0), _number_up_to(material, "roughness", _ROUGHEST))
    if coats and is_baked:
        raise values.error("materials", "with baked light, which nothing can reflect", "give a sky or an environment")
    return coats


def _number_up_to(values: JsonObject, name: str, highest: float) -> float:
    return values.number(name, 0, highest)


def _lamp(lamp: JsonObject) -> AreaLight:
    lamp.refuse_keys_except({"center", "half_u", "half_v", "radiance"})
    center, half_u, half_v = (_array(lamp, key, (3,)) for key in ("center", "half_u", "half_v"))
    if not np.cross(half_u, half_v).any():
        raise lamp.error("half_u", "spans no rectangle with half_v", "give two directions")
    return AreaLight(center, half_u, half_v, _radiance(lamp, "radiance", (3,)))


def _background(values: JsonObject, light: tuple[Environment, list[AreaLight]] | None) -> Array | None:
    """Return the uniform background (3,), or None where the environment is seen."""
    if values.holds("background", str):
        values.choice("background", ("environment",))
        if light is None:
            raise values.error("background", 'is "environment", but the light is baked', "give a color")
        return None
    if "background" not in values:
        return np.array(_BACKGROUND)
    background = _radiance(values, "background", (3,))
    if background.max() > 1:
        raise values.error("background", f"has {background.max():g}", "give what the picture shows, at most 1")
    return background


def _box(values: JsonObject, kind: str) -> Array | None:
    if "box" not in values:
        return None
    if kind == "walk":
        raise values.error("box", "with a walk, which is inside its scene", "leave the box out")
    box = _array(values, "box", (2, 3))
    if not (box[0] < box[1]).all():
        raise values.error("box", f"is {box.tolist()}", "give its lowest corner, then its highest")
    return box


def _views(values: JsonObject, kind: str, bounds: Array, caster: RayCaster) -> _Views:
    """Return the camera's path and the views beside it. The path is checked to keep clear of the mesh."""
    route: Callable[[float], Array]
    if kind == "around":
        center = _array(values, "center", (3,)) if "center" in values else bounds.mean(axis=0)
        radius = values.number("radius", *_SCALES, 0.5 * _RADII * float(np.linalg.norm(bounds[1] - bounds[0])))
        route = partial(paths.object_path, turns=values.number("turns", *_TURNS, 4.0), radius=radius, center=center)
        space = FreeSpace(caster, min(CLEARANCE, 0.13 * radius))
        views = _Views(
            route,
            lambda count: paths.object_validation_views(count, radius, center, space.is_free),
            lambda count, seed: paths.object_test_views(count, seed, radius, center, space.is_free),
        )
    else:
        try:
            route = walk = paths.WalkPath(*(_array(values, key, (None, 3)) for key in ("positions", "targets")))
        except DataError:
            raise
        except ValueError as error:
            raise DataError(values.path, f"path: {error}", _REMEDY) from error
        space = FreeSpace(caster, min(CLEARANCE, 0.13 * walk.size))
        views = _Views(
            route,
            lambda count: walk.validation_views(count, space.is_reached),
            lambda count, seed: walk.test_views(count, seed, space.is_reached),
        )
    try:
        space.check_path(route)
    except ValueError as error:
        raise DataError(values.path, str(error), "change the path or the scale") from error
    return views


def _exposed(scene: SimulationScene, renderer: Renderer) -> Renderer:
    """Scale the light so that no diffuse surface clips in the pictures. Clip surroundings and highlights to 1."""
    width, height = 192, 144
    poses = [scene.path((k + 0.5) / 48) for k in range(48)]
    poses += [*scene.validation_views(16), *scene.test_views(16, 0)]
    brightest = 0.0
    without_highlights = replace(renderer, reflections=None)
    for pose in poses:
        radiance, _, alpha = without_highlights.render(pose, scene.intrinsics(width, height), width, height, 1)
        brightest = max(brightest, float(radiance[alpha > 0].max(initial=0.0)))
    if brightest == 0:
        raise DataError(scene.name, "no light reaches what the camera sees", "give it light, or another path")
    return replace(renderer.with_gain(_BRIGHTEST / brightest), limit=1.0)


def _array(values: JsonObject, name: str, shape: tuple[int | None, ...]) -> Array:
    array = values.numbers(name, values.get(name, list), shape).numpy()
    if np.abs(array).max(initial=0) > _LARGEST:
        raise values.error(name, f"has {np.abs(array).max():g}", f"give numbers up to {_LARGEST:g}")
    if len(array) > _MOST_KNOTS:
        raise values.error(name, f"has {len(array)} rows", f"give at most {_MOST_KNOTS}")
    return array


def _radiance(values: JsonObject, name: str, shape: tuple[int | None, ...]) -> Array:
    radiance = _array(values, name, shape)
    if radiance.min() < 0:
        raise values.error(name, f"is {radiance.tolist()}", "radiance must not be negative")
    return radiance
