"""Open scenes: built-in ones, meshes and .blend files, and a scene.json with a mesh, its light and a camera's path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import astuple

from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.files.json_file import read_json
from aenerf_ns.files.limits import file_inside
from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.blender import BlenderRenderer, CameraTrack
from aenerf_ns.simulator.locomotive import locomotive_scene
from aenerf_ns.simulator.options import BLENDER_SUFFIX, BUILT_IN, DURATIONS, require_scene_file
from aenerf_ns.simulator.paths import CameraPath, ObjectPath, Obstacles, RoomPath, TrackPath, WalkPath
from aenerf_ns.simulator.rendering.environment import load_environment, sky
from aenerf_ns.simulator.rendering.lighting import AreaLight, baked_mesh, light_mesh
from aenerf_ns.simulator.rendering.mesh import Gloss, scaled
from aenerf_ns.simulator.rendering.mesh_loading import load_mesh
from aenerf_ns.simulator.rendering.mesh_repair import repair
from aenerf_ns.simulator.rendering.renderer import Renderer
from aenerf_ns.simulator.room import room_scene
from aenerf_ns.simulator.scene import SimulationScene

_RADIUS = 4.0
_RADII = 3.6
"""Default distance of the camera from an object: in meters, and in half diagonals of the object's bounds."""
_MAX_RADII_AWAY = 100
"""Half diagonals from the origin within which float32, in which rays are traced, tells the surfaces of a mesh apart."""
_MAX_RADIANCE = 0.9
"""Radiance that the brightest surface in probes of the path is scaled to, with room for brighter ones between them."""

# Wider than any scene needs. Beyond these limits float32, in which rays are traced, overflows, or the work never ends.
_Scale = Annotated[float, Meta(ge=1e-6, le=1e6)]
_Radiance = Annotated[float, Meta(ge=0, le=1e6)]
_Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Fraction = Annotated[float, Meta(ge=0, le=1)]
_Duration = Annotated[float, Meta(ge=DURATIONS[0], le=DURATIONS[1])]
_Color = tuple[_Radiance, _Radiance, _Radiance]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]
_Points = Annotated[list[_Point], Meta(min_length=4, max_length=10_000)]


class _Coat(Struct, forbid_unknown_fields=True, frozen=True):
    """The glossy coat of a material: see `Gloss`. The narrow lobe of reflections describes no rougher surfaces."""

    specular: _Fraction
    roughness: Annotated[float, Meta(ge=0, le=0.5)]


class _Lamp(Struct, forbid_unknown_fields=True, frozen=True):
    center: _Point
    half_u: _Point
    half_v: _Point
    radiance: _Color

    def __post_init__(self) -> None:
        if not np.cross(self.half_u, self.half_v).any():
            raise ValueError("half_u and half_v span no rectangle")


class _Light(Struct, forbid_unknown_fields=True, frozen=True):
    sky: tuple[_Color, _Color] | None = None
    environment: str | None = None
    turn_degrees: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    gain: _Scale = 1.0
    lamps: Annotated[list[_Lamp], Meta(max_length=100)] = []

    def __post_init__(self) -> None:
        if (self.sky is None) == (self.environment is None):
            raise ValueError("give either sky or environment")
        if self.environment is None and (self.turn_degrees, self.gain) != (0, 1):
            raise ValueError("turn_degrees and gain belong to an environment")


class _Around(Struct, tag_field="kind", tag="around", forbid_unknown_fields=True, frozen=True):
    center: _Point | None = None
    radius: _Scale | None = None
    turns: Annotated[float, Meta(ge=1e-3, le=1e3)] = 4.0
    duration: _Duration = 4.0
    focal_ratio: ClassVar[float] = 1.2


class _Walk(Struct, tag_field="kind", tag="walk", forbid_unknown_fields=True, frozen=True):
    positions: _Points
    targets: _Points
    duration: _Duration = 4.0
    focal_ratio: ClassVar[float] = 0.62


class _SceneFile(Struct, forbid_unknown_fields=True, frozen=True):
    """The contents of a scene.json. docs/simulator.md explains them."""

    mesh: str
    up: Literal["y", "z"] | None = None
    scale: _Scale = 1.0
    materials: dict[str, _Coat] = {}
    light: Literal["baked"] | _Light = _Light(sky=((0.25, 0.25, 0.25), (1.0, 1.0, 1.0)))
    background: Literal["environment"] | tuple[_Fraction, _Fraction, _Fraction] | None = None
    path: _Around | _Walk | None = None
    focal_ratio: Annotated[float, Meta(ge=0.01, le=100)] | None = None
    box: tuple[_Point, _Point] | None = None
    credits: Any = None

    def __post_init__(self) -> None:
        if self.light == "baked" and self.materials:
            raise ValueError("materials reflect nothing where the light is baked; give a sky or an environment")
        if self.light == "baked" and self.background == "environment":
            raise ValueError("there is no environment to show where the light is baked; give a color as background")
        if self.box is not None and isinstance(self.path, _Walk):
            raise ValueError("box: a walk is inside its scene; leave the box out")
        if self.box is not None and not np.less(*self.box).all():
            raise ValueError(f"box is {self.box}; give its lowest corner, then its highest")


def open_scene(name: str, seed: int = 0) -> SimulationScene:
    """Open a built-in scene by its name, or a mesh, .blend or scene.json by its file name. Its light takes seconds.

    The seed is that of the sampling of light, and of the patterns of built-in scenes.

    Raises:
        DataError: a file is missing or malformed, or the camera's path runs into the mesh.
    """
    if name not in BUILT_IN:
        return _load_scene(Path(name), seed)
    if name == "room":
        return SimulationScene(room_scene(seed), RoomPath(), focal_ratio=0.62, aabb=None)
    renderer, box = locomotive_scene(seed, shiny=name == "shiny_object"), np.array([[-1.2] * 3, [1.2] * 3])
    return SimulationScene(renderer, ObjectPath(), focal_ratio=1.2, aabb=box)


def _load_scene(path: Path, seed: int) -> SimulationScene:
    """Read and light a mesh or a .blend, with a scene.json or by itself."""
    require_scene_file(path)
    is_bare = path.suffix.lower() != ".json"
    values = _SceneFile(path.name) if is_bare else read_json(path, _SceneFile, "see docs/simulator.md")
    file = file_inside(path.parent, values.mesh, path)
    if file.suffix.lower() == BLENDER_SUFFIX:
        return _load_blend(path, file, values, seed)
    up = values.up or ("y" if file.suffix.lower() == ".glb" else "z")
    coats = {name: Gloss(*astuple(coat)) for name, coat in values.materials.items()}
    environment = None
    if isinstance(values.light, _Light):
        if values.light.sky is not None:
            environment = sky(*values.light.sky)
        elif values.light.environment is not None:
            panorama = file_inside(path.parent, values.light.environment, path)
            environment = load_environment(panorama, values.light.turn_degrees, values.light.gain)
    route = values.path or _Around()
    background = None if values.background == "environment" else np.array(values.background or (0.5, 0.5, 0.5))

    mesh, scale = load_mesh(file, up == "y", coats), values.scale
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    half_diagonal = 0.5 * float(np.linalg.norm(np.ptp(corners, axis=0)))
    if np.abs(corners).max() > _MAX_RADII_AWAY * half_diagonal > 0:
        problem = f"it lies around {corners.mean(axis=0).round(1)}, too far from the origin for its size"
        raise DataError(file, f"{problem} of {2 * half_diagonal:.3g}", "move it to the origin")
    if is_bare:
        scale = _RADIUS / (_RADII * half_diagonal) if half_diagonal > 0 else 1.0
    with value_errors_as_data_error(file, "give a mesh of triangles"):
        mesh, num_coincident = repair(scaled(mesh, scale))
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    notes = []
    if is_bare:
        notes.append(
            f"{path}: seen from {_RADIUS:g} m around it, under a plain sky, {up} up, scaled by {scale:.4g} to "
            f"{' x '.join(f'{side:.2f}' for side in np.ptp(bounds, axis=0))} m (a scene.json can say otherwise)"
        )
    if num_coincident:
        notes.append(
            f"{file}: {num_coincident} faces coincide with others; where they do, the first in the file is seen"
        )

    camera_path = _make_path(path, route, bounds, mesh.caster)
    if environment is None or values.light == "baked":
        renderer = baked_mesh(mesh, background)
    else:
        lamps = [AreaLight(*astuple(lamp)) for lamp in values.light.lamps]
        renderer = light_mesh(mesh, environment, lamps, background, seed=seed)
    focal_ratio, aabb = values.focal_ratio or route.focal_ratio, _scene_box(values, route, bounds, background)
    scene = SimulationScene(renderer, camera_path, focal_ratio, aabb, route.duration, tuple(notes))
    return scene if environment is None else _with_exposure(path, scene, renderer)


def _load_blend(path: Path, file: Path, values: _SceneFile, seed: int) -> SimulationScene:
    """Open a .blend that is a scene by itself, or the mesh of a scene.json."""
    default = _SceneFile(values.mesh)
    for name in ("up", "materials", "light"):
        if getattr(values, name) != getattr(default, name):
            raise DataError(path, f"{name} is given, but a .blend has its own", f"leave {name} out")
    renderer = BlenderRenderer(file, values.scale, values.background, values.path is None, seed)
    notes = renderer.notes
    if values.path is None and renderer.track is None:
        notes += (f"{path}: seen from around it, because its camera does not move (a scene.json can say otherwise)",)
    route = renderer.track or values.path or _Around()
    focal_ratio = values.focal_ratio or route.focal_ratio
    camera_path: CameraPath
    if isinstance(route, CameraTrack):
        # A gaze that turns by more would leave what the camera looks at.
        camera_path = TrackPath(route.poses, 0.31 / focal_ratio, renderer)
    else:
        camera_path = _make_path(path, route, renderer.bounds, renderer)
    aabb = _scene_box(values, route, renderer.bounds, renderer.background)
    scene = SimulationScene(renderer, camera_path, focal_ratio, aabb, route.duration, notes)
    width, height = 48, 36
    renderer.expose([scene.path((k + 0.5) / 12) for k in range(12)], scene.intrinsics(width, height), width, height)
    return scene


def _scene_box(
    values: _SceneFile, route: _Around | _Walk | CameraTrack, bounds: Array, background: Array | None
) -> Array | None:
    if values.box is not None:
        return np.array(values.box)
    if not isinstance(route, _Around) or background is None:
        return None
    return bounds + 0.025 * np.diff(bounds, axis=0) * [[-1], [1]]


def _make_path(source: Path, route: _Around | _Walk, bounds: Array, obstacles: Obstacles) -> CameraPath:
    try:
        if isinstance(route, _Walk):
            return WalkPath(route.positions, route.targets, obstacles)
        center = bounds.mean(axis=0) if route.center is None else route.center
        radius = route.radius or 0.5 * _RADII * float(np.linalg.norm(bounds[1] - bounds[0]))
        return ObjectPath(route.turns, radius, center, obstacles)
    except ValueError as error:
        raise DataError(source, f"path: {error}", "change the path or the scale, see docs/simulator.md") from error


def _with_exposure(source: Path, scene: SimulationScene, renderer: Renderer) -> SimulationScene:
    """Scale the light so that no diffuse surface clips in the pictures. Clip surroundings and highlights to 1."""
    width, height = 192, 144
    poses = [scene.path((k + 0.5) / 48) for k in range(48)]
    poses += [*scene.path.validation_views(16), *scene.path.test_views(16, 0)]
    brightest = 0.0
    without_highlights = replace(renderer, reflections=None)
    for pose in poses:
        radiance, depth = without_highlights.render(pose, scene.intrinsics(width, height), width, height, 1)
        brightest = max(brightest, float(radiance[np.isfinite(depth)].max(initial=0.0)))
    if brightest == 0:
        raise DataError(source, "no light reaches what the camera sees", "give it light, or another path")
    return replace(scene, renderer=replace(renderer, gain=_MAX_RADIANCE / brightest, limit=1.0))
