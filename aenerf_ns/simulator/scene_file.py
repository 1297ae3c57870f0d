"""Meshes as scenes of the simulator: scene.json, with a mesh, its light and the camera's path, or a mesh alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.simulator import paths
from aenerf_ns.simulator.free_space import FreeSpace
from aenerf_ns.simulator.rendering.embree import RayCaster
from aenerf_ns.simulator.rendering.environment import Environment, load_environment, sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, baked_mesh, light_mesh
from aenerf_ns.simulator.rendering.mesh import Mesh, scaled
from aenerf_ns.simulator.rendering.mesh_loading import SUFFIXES, load_mesh
from aenerf_ns.simulator.rendering.mesh_repair import prepared
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.scene import SimulationScene

Array = NDArray[np.float64]

CLEARANCE = 0.15
"""Distance in metres that cameras keep from a mesh; less along a path of less than about a metre."""
_FOCAL_RATIO = {"around": 1.2, "walk": 0.62}
_SKY = [[0.25, 0.25, 0.25], [1.0, 1.0, 1.0]]
_BACKGROUND = [0.5, 0.5, 0.5]
_RADIUS = 4.0
_RADII = 3.6
"""Distance from which an object is looked at by default: in metres, and in half diagonals of its bounds."""
_DURATION = 4.0
_BRIGHTEST = 0.9
"""What the brightest surface that probes of the path see is brought to: it leaves room for what they miss."""

_KEYS = {"mesh", "up", "scale", "light", "background", "path", "focal_ratio", "box", "credits"}


@dataclass(frozen=True)
class _Views:
    path: Callable[[float], Array]
    validation: Callable[[int], Array]
    test: Callable[[int, int], Array]


def load_scene(path: Path, seed: int = 0) -> SimulationScene:
    """Read and light a mesh, from a scene.json or by itself.

    Args:
        path: .json, .glb, .obj or .ply.
        seed: of the sampling of light.

    Raises:
        DataError: a file is missing or malformed, or the camera's path runs into the mesh.
    """
    bare = path.suffix.lower() in SUFFIXES
    if not bare and path.suffix.lower() != ".json":
        raise DataError(path, "an unknown scene", 'give "room", "object", a .glb, .obj or .ply file, or a scene.json')
    values: dict[str, Any] = {"mesh": path.name} if bare else _read(path)
    file = path.parent / _text(path, values, "mesh")
    up = values.get("up", "y" if file.suffix.lower() == ".glb" else "z")
    if up not in ("y", "z"):
        raise DataError(path, f"up is {up!r}", 'give "y" or "z"')
    scale = _positive(path, values, "scale", 1.0)
    light = _light(path, values.get("light", {"sky": _SKY}))
    background = _background(path, values.get("background", _BACKGROUND), light)
    route = values.get("path", {"kind": "around"})
    kind = _kind(path, route)
    duration = _positive(path, route, "duration", _DURATION)
    focal_ratio = _positive(path, values, "focal_ratio", _FOCAL_RATIO[kind])
    box = _box(path, values.get("box"), kind)

    mesh = load_mesh(file, up == "y")
    if bare:
        scale = _half_diagonal_scale(mesh)
    try:
        mesh, coincident = prepared(scaled(mesh, scale))
    except ValueError as error:
        raise DataError(file, str(error), "give a mesh of triangles") from error
    bounds = np.stack([mesh.vertices[mesh.faces].min(axis=(0, 1)), mesh.vertices[mesh.faces].max(axis=(0, 1))])
    if box is None and kind == "around" and background is not None:
        box = bounds + 0.025 * np.diff(bounds, axis=0) * [[-1], [1]]
    notes = []
    if bare:
        notes.append(
            f"{path}: seen from {_RADIUS:g} m around it, under a plain sky, {up} up, scaled by {scale:.4g} to "
            f"{' x '.join(f'{side:.2f}' for side in np.diff(bounds, axis=0)[0])} m (a scene.json can say otherwise)"
        )
    if coincident:
        notes.append(f"{file}: {coincident} faces coincide with others; where they do, the first in the file is seen")

    caster = RayCaster(mesh.vertices, mesh.faces)
    views = _views(path, route, bounds, caster)
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


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DataError(path, "the file does not exist", "check the name")
    try:
        values = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(path, f"not JSON ({error})", "see docs/simulator.md") from error
    if not isinstance(values, dict) or "mesh" not in values:
        raise DataError(path, 'no "mesh" in it', "see docs/simulator.md")
    unknown = sorted(set(values) - _KEYS)
    if unknown:
        raise DataError(path, f"unknown key {unknown[0]!r}", f"known are {', '.join(sorted(_KEYS))}")
    return values


def _half_diagonal_scale(mesh: Mesh) -> float:
    """Brings the mesh's bounds into view from the default distance."""
    corners = mesh.vertices[mesh.faces]
    half_diagonal = 0.5 * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    return _RADIUS / (_RADII * half_diagonal) if half_diagonal > 0 else 1.0


def _background(path: Path, value: Any, light: tuple[Environment, list[AreaLight]] | None) -> Array | None:
    """The uniform background, or None where the environment is seen."""
    if isinstance(value, str) and value == "environment":
        if light is None:
            raise DataError(path, "the environment as background of baked light", "give a colour")
        return None
    background = _radiance(path, "background", value)
    if background.max() > 1:
        raise DataError(path, f"background is {value}", "give what the picture shows, at most 1")
    return background


def _box(path: Path, value: Any, kind: str) -> Array | None:
    if value is None:
        return None
    if kind == "walk":
        raise DataError(path, "a box with a walk, which is inside its scene", 'leave "box" out')
    box = _array(path, "box", value, (2, 3))
    if not (box[0] < box[1]).all():
        raise DataError(path, f"box is {value}", "give its lowest corner, then its highest")
    return box


def _light(path: Path, light: Any) -> tuple[Environment, list[AreaLight]] | None:
    """The environment and the lamps, or None for baked light."""
    if light == "baked":
        return None
    if not isinstance(light, dict) or ("sky" in light) == ("environment" in light):
        raise DataError(path, 'light is neither "baked" nor has it one of "sky" and "environment"', "give one")
    known = {"sky", "lamps"} if "sky" in light else {"environment", "turn_degrees", "gain", "lamps"}
    if unknown := sorted(set(light) - known):
        raise DataError(path, f"unknown key {unknown[0]!r} in light", f"known are {', '.join(sorted(known))}")
    if "sky" in light:
        environment = sky(*_radiance(path, "light.sky", light["sky"], (2, 3)))
    else:
        turn = float(_array(path, "light.turn_degrees", light.get("turn_degrees", 0), ()))
        file = path.parent / _text(path, light, "environment")
        environment = load_environment(file, turn, _positive(path, light, "gain", 1.0))
    lamps = light.get("lamps", [])
    if not isinstance(lamps, list) or not all(isinstance(lamp, dict) for lamp in lamps):
        raise DataError(path, "light.lamps is not a list of objects", "see docs/simulator.md")
    made = []
    for i, lamp in enumerate(lamps):
        if set(lamp) != {"centre", "half_u", "half_v", "radiance"}:
            raise DataError(path, f"light.lamps[{i}] has {sorted(lamp)}", "give centre, half_u, half_v and radiance")
        name = f"light.lamps[{i}]"
        centre, half_u, half_v = (
            _array(path, f"{name}.{key}", lamp[key], (3,)) for key in ("centre", "half_u", "half_v")
        )
        made.append(AreaLight(centre, half_u, half_v, _radiance(path, f"{name}.radiance", lamp["radiance"])))
    return environment, made


def _kind(path: Path, value: Any) -> str:
    known = {
        "around": {"kind", "centre", "radius", "turns", "duration"},
        "walk": {"kind", "positions", "targets", "duration"},
    }
    kind = value.get("kind") if isinstance(value, dict) else None
    if kind not in known:
        raise DataError(path, f"path.kind is {kind!r}", 'give "around" or "walk"')
    if unknown := sorted(set(value) - known[kind]):
        raise DataError(path, f"unknown key {unknown[0]!r} in path", f"known are {', '.join(sorted(known[kind]))}")
    return kind


def _views(path: Path, value: dict[str, Any], bounds: Array, caster: RayCaster) -> _Views:
    """The camera's path and the views beside it, checked to keep clear of the mesh."""
    route: Callable[[float], Array]
    if value["kind"] == "around":
        centre = _array(path, "path.centre", value.get("centre", bounds.mean(axis=0).tolist()), (3,))
        radius = _positive(path, value, "radius", 0.5 * _RADII * float(np.linalg.norm(bounds[1] - bounds[0])))
        route = partial(paths.object_path, turns=_positive(path, value, "turns", 4.0), radius=radius, centre=centre)
        space = FreeSpace(caster, min(CLEARANCE, 0.13 * radius))
        views = _Views(
            route,
            lambda count: paths.object_validation_views(count, radius, centre, space.is_free),
            lambda count, seed: paths.object_test_views(count, seed, radius, centre, space.is_free),
        )
    else:
        points = [_array(path, f"path.{key}", value.get(key), (None, 3)) for key in ("positions", "targets")]
        try:
            route = walk = paths.WalkPath(*points)
        except ValueError as error:
            raise DataError(path, f"path: {error}", "see docs/simulator.md") from error
        space = FreeSpace(caster, min(CLEARANCE, 0.13 * walk.size))
        views = _Views(
            route,
            lambda count: walk.validation_views(count, space.is_reached),
            lambda count, seed: walk.test_views(count, seed, space.is_reached),
        )
    try:
        space.check_path(route)
    except ValueError as error:
        raise DataError(path, str(error), "change the path or the scale") from error
    return views


def _exposed(scene: SimulationScene, renderer: Renderer) -> Renderer:
    """The scene with its light scaled so that no surface clips in the pictures, and its surroundings cut off there."""
    width, height = 192, 144
    poses = [scene.path((k + 0.5) / 48) for k in range(48)]
    poses += [*scene.validation_views(16), *scene.test_views(16, 0)]
    brightest = 0.0
    for pose in poses:
        radiance, _, alpha = renderer.render(pose, scene.intrinsics(width, height), width, height, 1)
        brightest = max(brightest, float(radiance[alpha > 0].max(initial=0.0)))
    if brightest == 0:
        raise DataError(scene.name, "no light reaches what the camera sees", "give it light, or another path")
    gain = _BRIGHTEST / brightest
    seen = renderer.surroundings
    return replace(
        renderer,
        light=(gain * renderer.light).astype(np.float32),
        surroundings=seen._replace(texels=(gain * seen.texels).astype(np.float32)),
        limit=1.0,
    )


def _array(path: Path, name: str, value: Any, shape: tuple[int | None, ...]) -> Array:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    fits = array.ndim == len(shape) and all(b in (a, None) for a, b in zip(array.shape, shape, strict=True))
    if not fits or value is None or not np.isfinite(array).all():
        wanted = " x ".join("n" if side is None else str(side) for side in shape) or "1"
        raise DataError(path, f"{name} is {json.dumps(value)[:80]}", f"give {wanted} numbers")
    return array


def _radiance(path: Path, name: str, value: Any, shape: tuple[int, ...] = (3,)) -> Array:
    radiance = _array(path, name, value, shape)
    if radiance.min() < 0:
        raise DataError(path, f"{name} is {value}", "radiance must not be negative")
    return radiance


def _positive(path: Path, values: dict[str, Any], key: str, default: float) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise DataError(path, f"{key} is {value!r}", "give a positive number")
    return float(value)


def _text(path: Path, values: dict[str, Any], key: str) -> str:
    value = values.get(key)
    if not isinstance(value, str) or not value:
        raise DataError(path, f"{key} is {value!r}", "give the name of a file beside it")
    return value
