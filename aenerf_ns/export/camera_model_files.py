"""Images with their cameras and poses, as other trainers take them: a COLMAP model and a transforms.json."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL

IMAGE_FOLDER, SPARSE_FOLDER, TRANSFORMS_FILE, POINTS_FILE = "images", "sparse/0", "transforms.json", "points.ply"
"""Names of the written folders and files. Trainers of splats and NeRFs look for these names."""

_SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class PlacedImage:
    """An image with its camera.

    Attributes:
        name: path relative to the folder of images.
        camera: the lens that took the image.
        camera_to_world: (4, 4) float64 pose, OpenCV camera axes.
        split: "train", "val" or "test"; None where images are not split.
        depth: path of its depth, relative to the folder that transforms.json is in, or None.
    """

    name: str
    camera: CameraIntrinsics
    camera_to_world: NDArray[np.float64]
    split: str | None = None
    depth: str | None = None


@dataclass(frozen=True)
class SeenPoints:
    """Points of a scene, each seen in one image.

    Attributes:
        positions: (N, 3) float64 in the world.
        colors: (N, 3) uint8 display values.
        images: (N,) index of the image.
        pixels: (N, 2) column and row in that image; the centre of the first pixel is at 0.5.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    images: NDArray[np.int64]
    pixels: NDArray[np.float64]


def write_colmap_model(folder: Path, images: Sequence[PlacedImage], points: SeenPoints) -> None:
    """Write a COLMAP model in binary form, and the lists of images that Nerfstudio's ``colmap`` dataparser splits by.

    Args:
        folder: that the model's folder ``sparse/0`` and the lists are written to.
        images: in the order of their numbers in the model, which begin with 1.
        points: of the model; each has a track of one image.
    """
    # Imported lazily, because few commands need it.
    import pycolmap

    model = pycolmap.Reconstruction()
    numbers: dict[CameraIntrinsics, int] = {}
    for image in images:
        if image.camera not in numbers:
            numbers[image.camera] = len(numbers) + 1
            model.add_camera_with_trivial_rig(_colmap_camera(image.camera, numbers[image.camera]))
    for index, image in enumerate(images):
        world_to_camera = np.linalg.inv(image.camera_to_world)
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                keypoints=points.pixels[points.images == index],
                camera_id=numbers[image.camera],
                image_id=index + 1,
            ),
            pycolmap.Rigid3d(world_to_camera[:3]),
        )
    # Of how many points before it in the same image.
    place = np.zeros(len(images), np.int64)
    for position, color, image_index in zip(points.positions, points.colors, points.images, strict=True):
        element = pycolmap.TrackElement(int(image_index) + 1, int(place[image_index]))
        place[image_index] += 1
        model.add_point3D(position, pycolmap.Track([element]), color)
    sparse = folder / SPARSE_FOLDER
    sparse.mkdir(parents=True)
    model.write(str(sparse))
    for split, names in _names_by_split(images, "").items():
        (folder / f"{split}_list.txt").write_text("".join(f"{name}\n" for name in names), "utf8")


def write_transforms(folder: Path, images: Sequence[PlacedImage], points: SeenPoints) -> None:
    """Write ``transforms.json`` and ``points.ply``, as Nerfstudio's ``nerfstudio`` dataparser reads them.

    Poses are camera-to-world with OpenGL camera axes, in the same world as ``points.ply``.
    """
    frames = []
    for image in images:
        frame = {
            "file_path": f"{IMAGE_FOLDER}/{image.name}",
            **_transforms_camera(image.camera),
            "transform_matrix": (image.camera_to_world @ OPENCV_TO_OPENGL.numpy()).tolist(),
        }
        if image.depth is not None:
            frame["depth_file_path"] = image.depth
        frames.append(frame)
    splits = _names_by_split(images, f"{IMAGE_FOLDER}/")
    meta: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if images[0].camera.lens_model == "fisheye" else "OPENCV",
        # The world of the poses is the original one. Without this line the framework would guess another.
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": POINTS_FILE,
        **{f"{split}_filenames": names for split, names in splits.items()},
        "frames": frames,
    }
    (folder / TRANSFORMS_FILE).write_text(json.dumps(meta, indent=1) + "\n", "utf8")
    _write_ply(folder / POINTS_FILE, points)


def _names_by_split(images: Sequence[PlacedImage], prefix: str) -> dict[str, list[str]]:
    """Return the images' names by split, none where images are not split.

    A split without images gets those of the other held-out split, because the framework asks for all three.
    """
    names = {split: [prefix + image.name for image in images if image.split == split] for split in _SPLITS}
    if not names["train"] or not (names["val"] or names["test"]):
        return {}
    return {**names, "val": names["val"] or names["test"], "test": names["test"] or names["val"]}


def _colmap_camera(camera: CameraIntrinsics, number: int) -> Any:
    import pycolmap

    basic = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.lens_model == "fisheye":
        model, parameters = "OPENCV_FISHEYE", [*basic, *camera.distortion]
    elif not any(camera.distortion):
        model, parameters = "PINHOLE", basic
    elif camera.distortion[4] == 0:
        model, parameters = "OPENCV", [*basic, *camera.distortion[:4]]
    else:
        # k4, k5 and k6 are those of the denominator.
        model, parameters = "FULL_OPENCV", [*basic, *camera.distortion, 0.0, 0.0, 0.0]
    return pycolmap.Camera(camera_id=number, model=model, width=camera.width, height=camera.height, params=parameters)


def _transforms_camera(camera: CameraIntrinsics) -> dict[str, float]:
    names = ("k1", "k2", "k3", "k4") if camera.lens_model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **dict(zip(names, camera.distortion, strict=True)),
    }


def _write_ply(path: Path, points: SeenPoints) -> None:
    import trimesh

    trimesh.PointCloud(points.positions, colors=points.colors).export(path)
