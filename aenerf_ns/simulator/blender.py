"""Scenes of Blender: Cycles renders a .blend file, on the CPU.

Blender is one for the whole process. It holds one file at a time: opening another ends the renderer of the first. Only
the main thread may use it.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.simulator.arrays import Array
from aenerf_ns.simulator.rendering.renderer import POINT_SPREAD

_GRAY = (0.5, 0.5, 0.5)
_ON_DISK = {"FILE", "MOVIE", "SEQUENCE", "TILED"}
_SURFACES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Blender's camera has OpenGL's axes: x right, y up, z backwards."""
_SENSOR_WIDTH = 1000.0
"""In millimeters: so wide that no lens is too short for Blender, which takes 1 mm at least."""
_MIN_SIZE = 4
"""Pixels that Blender's pictures have at least, in width and in height."""
_NOWHERE = 1e9
"""A depth beyond all surfaces. Cycles has 1e10 where there is none."""
_PATHS_PER_RAY = 4
"""Light that bounces at random needs more samples than edges do."""
_MARGIN = 8
"""Pixels around a picture that are rendered and cut off: denoising makes ripples at the rim."""
_DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
_MAX_RADIANCE, _PERCENTILE = 0.9, 99.0


class CameraTrack(NamedTuple):
    """The moves of a file's camera."""

    poses: Array  # (N, 4, 4) at the frames of the animation, camera-to-world, OpenCV axes, meters
    duration: float  # seconds
    focal_ratio: float  # focal length divided by image width


class BlenderRenderer:
    """Render a .blend file as it stands at the first frame of its animation, and tell how far its surfaces are.

    A picture has a fixed pattern of noise, which is denoised: a still camera sees a still picture.

    Args:
        path: the .blend file. Scripts in it are not run.
        scale: meters per meter of the file.
        background: linear RGB where a ray hits nothing. "environment" shows the world of the file instead. None does
            what the file says: gray if its film is transparent, else its world.
        follow: whether the moves of the file's camera are wanted.
        seed: of the noise.

    Raises:
        DataError: Blender is not installed, or the file is damaged, or it lacks a texture or surfaces, or its camera
            cannot be followed.

    Attributes:
        background: (3,), or None if the world is shown.
        bounds: (2, 3) lowest and highest corner of all surfaces.
        track: the moves of the file's camera, or None if they are not wanted or it does not move.
        notes: what the user should know, a line each.
    """

    def __init__(
        self,
        path: Path,
        scale: float = 1.0,
        background: Sequence[float] | Literal["environment"] | None = None,
        follow: bool = True,
        seed: int = 0,
    ) -> None:
        self._path = path
        self._bpy = bpy = _open(path)
        self._scene = scene = bpy.context.scene
        self._scale, self._gain = scale * scene.unit_settings.scale_length, 1.0
        self.notes: tuple[str, ...] = ()
        # Materials of Blender before 2.80 could have textures of another kind, which no material has today.
        unseen = sorted(each.name for each in bpy.data.textures if each.type == "IMAGE" and not each.users)
        if unseen:
            names = ", ".join(unseen)
            self.notes += (f"{path}: surfaces are plain that had textures of Blender 2.79 or older: {names}",)
        self.track = self._read_track() if follow else None
        scene.frame_set(scene.frame_start)
        scene.timeline_markers.clear()  # Some switch to another camera.
        if background is None:
            background = _GRAY if scene.render.film_transparent else "environment"
        self.background = None if background == "environment" else np.array(background, np.float64)
        self._camera = bpy.data.objects.new("event camera", bpy.data.cameras.new("event camera"))
        scene.collection.objects.link(self._camera)
        scene.camera = self._camera
        # Blender measures distances only to what the viewport shows.
        for item in (*bpy.data.objects, *bpy.data.collections):
            item.hide_viewport = item.hide_render
        collections = [bpy.context.view_layer.layer_collection]
        # The list grows while it is walked, by the children of each collection.
        for collection in collections:
            collection.hide_viewport = False
            collections += collection.children
        for item in bpy.context.view_layer.objects:
            item.hide_set(False)
        self._depsgraph = bpy.context.evaluated_depsgraph_get()
        boxes = [
            np.array(each.object.bound_box) @ np.array(each.matrix_world)[:3, :3].T + each.matrix_world.translation
            for each in self._depsgraph.object_instances
            if each.object.type in _SURFACES and each.show_self and each.object.visible_camera
        ]
        if not boxes:
            raise DataError(path, "it has no surfaces to render", "give a scene with objects that are rendered")
        corners = np.concatenate(boxes) * self._scale
        self.bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
        self._folder = TemporaryDirectory()
        with _silence():
            self._set_up(seed)

    def _read_track(self) -> CameraTrack | None:
        """Read the moves of the file's camera."""
        path, scene = self._path, self._scene
        camera, poses, lenses = scene.camera, [], set()
        if camera is not None:
            for frame in range(scene.frame_start, scene.frame_end + 1):
                scene.frame_set(frame)
                location, rotation, _ = scene.camera.matrix_world.decompose()
                pose = np.array(rotation.to_matrix().to_4x4()) @ _FLIP
                pose[:3, 3] = np.array(location) * self._scale
                poses.append(pose)
                corner, *_, other = scene.camera.data.view_frame(scene=scene)
                lenses.add((scene.camera.name, scene.camera.data.type, round(-corner.z / (corner.x - other.x), 6)))
        if not poses or np.ptp(poses, axis=0).max() < 1e-6:
            return None
        _, kind, focal_ratio = lenses.pop()
        problem = None
        if lenses:
            problem = "the camera or its lens changes"
        elif kind != "PERSP":
            problem = f"its camera is of type {kind}"
        elif camera.data.shift_x or camera.data.shift_y:
            problem = f"the lens of its camera is shifted by {camera.data.shift_x:g} and {camera.data.shift_y:g}"
        if problem:
            raise DataError(path, problem, "give a file with one perspective camera, or a path in a scene.json")
        fps = scene.render.fps / scene.render.fps_base
        self.notes += (
            f"{path}: the path of its camera {camera.name!r}, frames {scene.frame_start} to {scene.frame_end} at "
            f"{fps:g} frames a second",
        )
        return CameraTrack(np.array(poses), (len(poses) - 1) / fps, focal_ratio)

    def _set_up(self, seed: int) -> None:
        """Make Cycles write color and depth, in place of what else the file wants."""
        scene, layer = self._scene, self._bpy.context.view_layer
        render, cycles, image = scene.render, scene.cycles, scene.render.image_settings
        render.engine, cycles.device = "CYCLES", "CPU"
        render.threads_mode, render.threads = "FIXED", torch.get_num_threads()
        render.use_persistent_data = render.use_compositing = True
        render.use_border = render.use_motion_blur = render.use_multiview = render.use_sequencer = False
        render.use_stamp = render.use_freestyle = False
        render.resolution_percentage, render.pixel_aspect_x, render.pixel_aspect_y = 100, 1.0, 1.0
        render.film_transparent = self.background is not None
        cycles.seed, cycles.use_animated_seed, cycles.use_adaptive_sampling = seed % (1 << 31), False, False
        cycles.use_guiding, cycles.use_sample_subset, cycles.use_layer_samples = False, False, "IGNORE"
        cycles.time_limit, cycles.pixel_filter_type = 0.0, "GAUSSIAN"
        # Noise of the albedo and the normals would be kept as if it were texture, or cost two denoisings more.
        cycles.denoiser, cycles.denoising_input_passes, cycles.denoising_quality = "OPENIMAGEDENOISE", "RGB", "HIGH"
        image.media_type, image.file_format, image.color_depth, image.color_mode = "IMAGE", "OPEN_EXR", "32", "RGBA"
        image.exr_codec, image.color_management = "NONE", "FOLLOW_SCENE"
        image.linear_colorspace_settings.name = "Linear Rec.709"
        self._camera.data.sensor_fit, self._camera.data.sensor_width = "HORIZONTAL", _SENSOR_WIDTH
        self._camera.data.clip_start, self._camera.data.clip_end = 1e-3, 1e6
        for each in scene.view_layers:
            each.use = each == layer
        layer.use_pass_z = True
        # The picture lies over the background, and the depth takes the place of its alpha.
        tree = scene.compositing_node_group = self._bpy.data.node_groups.new("color and depth", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        kinds = "CompositorNodeRLayers", "CompositorNodeAlphaOver", "CompositorNodeSetAlpha", "NodeGroupOutput"
        picture, over, alpha, output = (tree.nodes.new(kind) for kind in kinds)
        picture.scene, picture.layer = scene, layer.name
        alpha.inputs["Type"].default_value = "Replace Alpha"
        self._behind = over.inputs["Background"]
        tree.links.new(picture.outputs["Image"], over.inputs["Foreground"])
        tree.links.new(over.outputs["Image"], alpha.inputs["Image"])
        tree.links.new(picture.outputs["Depth"], alpha.inputs["Alpha"])
        tree.links.new(alpha.outputs["Image"], output.inputs["Image"])

    def expose(self, poses: ArrayLike, intrinsics: Sequence[float], width: int, height: int) -> None:
        """Scale the light so that 99 % of what is seen from poses (N, 4, 4) is darker than 0.9.

        Raises:
            DataError: all is black, or nothing is in sight.
        """
        seen = [self.render(pose, intrinsics, width, height, 16, limit=np.inf) for pose in np.asarray(poses)]
        brightness = np.concatenate(
            [radiance.max(-1)[np.isfinite(depth) | (self.background is None)] for radiance, depth in seen]
        )
        level = float(np.percentile(brightness, _PERCENTILE)) if len(brightness) else 0.0
        if level == 0:
            raise DataError(self._path, "no light reaches what the camera sees", "give it light, or another path")
        self._gain *= _MAX_RADIANCE / level

    def render(
        self,
        camera_to_world: ArrayLike,
        intrinsics: Sequence[float],
        width: int,
        height: int,
        samples: int,
        limit: float = 1.0,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Render a picture through a pinhole camera.

        Args:
            camera_to_world, intrinsics, width, height: see `Renderer.render`. Pixels are square: fy is not used.
            samples: a quarter of the rays per pixel; or 1 for a single one, through the center and not denoised.
            limit: brighter radiance is clipped to this value.

        Returns:
            radiance (H, W, 3), linear RGB; depth (H, W) along the optical axis, of one of the rays, inf where it hits
            nothing. Both are float32.
        """
        bpy, scene, lens = self._bpy, self._scene, self._camera.data
        focal, _, cx, cy = map(float, intrinsics)
        margin = _MARGIN if samples > 1 else 0
        columns, rows = max(width + 2 * margin, _MIN_SIZE), max(height + 2 * margin, _MIN_SIZE)
        scene.render.resolution_x, scene.render.resolution_y = columns, rows
        scene.cycles.use_denoising = samples > 1
        scene.cycles.samples = _PATHS_PER_RAY * samples if samples > 1 else 1
        # Cycles' width of a Gaussian is four standard deviations.
        scene.cycles.filter_width = 4 * POINT_SPREAD if samples > 1 else 0.01
        lens.lens = _SENSOR_WIDTH * focal / columns
        lens.shift_x, lens.shift_y = 0.5 - (cx + margin) / columns, (cy + margin - rows / 2) / columns
        pose = np.eye(4)
        pose[:3] = np.asarray(camera_to_world, np.float64)[:3] @ _FLIP
        pose[:3, 3] /= self._scale
        self._camera.matrix_world = pose.T.tolist()
        if self.background is not None:
            self._behind.default_value = (*(self.background / self._gain), 1.0)
        with _signals_held():
            bpy.ops.render.render()
        # The pixels of a rendering can be read from a file alone.
        file = str(Path(self._folder.name) / "rendering.exr")
        bpy.data.images["Render Result"].save_render(file, scene=scene)
        image = bpy.data.images.load(file)
        image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
        pixels = np.empty((rows, columns, 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
        bpy.data.images.remove(image)
        pixels = pixels[::-1][margin : margin + height, margin : margin + width]
        depth = np.where(pixels[..., 3] < _NOWHERE, pixels[..., 3] * np.float32(self._scale), np.float32(np.inf))
        return np.clip(pixels[..., :3] * np.float32(self._gain), 0, limit), depth

    def _hit(self, origin: Array, direction: Array, reach: float) -> float:
        """Return how far a ray goes before it hits a surface, inf if farther than ``reach``."""
        start = origin / self._scale
        hit, place, *_ = self._scene.ray_cast(self._depsgraph, start, direction, distance=reach / self._scale)
        return float(np.linalg.norm(np.array(place) - start)) * self._scale if hit else np.inf

    def distance(self, points: ArrayLike) -> Array:
        """Return the distance (N,) of points (N, 3) from the nearest surface that one of 26 rays hits."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        return np.array([min(self._hit(point, ray, 1e6) for ray in _DIRECTIONS) for point in points])

    def blocked(self, rays: ArrayLike) -> NDArray[np.bool_]:
        """Tell for each ray (N, 6) whether a surface lies between its origin and origin + direction."""
        rays = np.asarray(rays, np.float64).reshape(-1, 6)
        reach = np.linalg.norm(rays[:, 3:], axis=1)
        return np.array([r > 0 and self._hit(ray[:3], ray[3:], r) < r for ray, r in zip(rays, reach, strict=True)])


def _open(path: Path) -> Any:
    """Return Blender's module after it opened a file."""
    try:
        import bpy
    except ImportError as error:
        remedy = "pip install 'aenerf-ns[blender]', in Python 3.11"
        raise DataError(path, f"Blender's package is missing to read it ({error})", remedy) from error
    try:
        with _silence():
            bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise DataError(path, f"Blender cannot open it ({str(error).strip()})", "save it again in Blender") from error
    _require_files(bpy, path)
    return bpy


@contextmanager
def _signals_held() -> Iterator[None]:
    """Act on Ctrl-C and SIGTERM after the context, in the main thread.

    Parts of Blender are written in Python. An exception that a signal raises there would not reach the caller.
    """
    held: list[int] = []
    handlers = {
        number: signal.signal(number, lambda number, _: held.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for caught in held[:1]:
        signal.raise_signal(caught)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the console free from what Blender, and not Python, prints within the context."""
    sys.stdout.flush()
    sys.stderr.flush()
    with open(os.devnull, "wb") as nowhere, ExitStack() as restoring:
        for stream in (1, 2):
            original = os.dup(stream)
            restoring.callback(os.close, original)
            restoring.callback(os.dup2, original, stream)
            os.dup2(nowhere.fileno(), stream)
        yield


def _require_files(bpy: Any, path: Path) -> None:
    """Raise a DataError if a file is missing that a surface, a light, the world or a linked object comes from.

    If a file is not where the scene expects it, it is looked for in the folder of the scene and in the folders within.
    """
    if _missing_files(bpy):
        with _silence(), suppress(RuntimeError):
            bpy.ops.file.find_missing_files(directory=str(path.resolve().parent))
            # A linked object appears once its file is read.
            for library in bpy.data.libraries:
                library.reload()
    missing = _missing_files(bpy)
    if missing:
        remedy = "put them into the folder of the scene, or pack them into it in Blender"
        raise DataError(path, f"files that it uses are missing: {', '.join(missing)}", remedy)


def _missing_files(bpy: Any) -> list[str]:
    images = [
        image
        for image in bpy.data.images
        if image.source in _ON_DISK and not image.packed_files and not os.path.exists(image.filepath_from_user())
    ]
    users = bpy.data.user_map(subset=images, value_types={"MATERIAL", "WORLD", "LIGHT", "NODETREE"})
    missing = {image.filepath for image in images if users.get(image)}
    missing |= {each.filepath for each in bpy.data.libraries if not os.path.exists(bpy.path.abspath(each.filepath))}
    return sorted(missing)
