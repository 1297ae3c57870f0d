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
from aenerf_ns.recording.recording import SPLITS, Split

IMAGE_FOLDER, SPARSE_FOLDER, TRANSFORMS_FILE, POINTS_FILE = "images", "sparse/0", "transforms.json", "points.ply"
"""Names of the written folders and files. Trainers of splats and NeRFs look for these names."""


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
class ObservedPoints:
    """Points of a scene, each seen in one image.

    Attributes:
        positions: (N, 3) float64 in the world.
        colors: (N, 3) uint8 display values.
        images: (N,) index of the image.
        pixels: (N, 2) column and row in that image; the center of the first pixel is at 0.5.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    images: NDArray[np.int64]
    pixels: NDArray[np.float64]


def write_cameras(folder: Path, images: Sequence[PlacedImage], points: ObservedPoints) -> None:
    """Write the cameras of images of one lens as a COLMAP model and as a transforms.json, with points of the scene."""
    _write_colmap_model(folder, images, points)
    _write_transforms(folder, images, points)


def _write_colmap_model(folder: Path, images: Sequence[PlacedImage], points: ObservedPoints) -> None:
    """Write a COLMAP model in binary form, and the lists of images that Nerfstudio's ``colmap`` dataparser splits by.

    Images have the numbers of their order from 1 on, and each point has a track of one image.
    """
    # Imported lazily, because few commands need it.
    import pycolmap

    model, camera = pycolmap.Reconstruction(), images[0].camera
    name, parameters = camera.to_colmap()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=name, width=camera.width, height=camera.height, params=parameters)
    )
    for index, image in enumerate(images):
        seen = points.images == index
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=image.name, keypoints=points.pixels[seen], camera_id=1, image_id=index + 1),
            pycolmap.Rigid3d(np.linalg.inv(image.camera_to_world)[:3]),
        )
        for row, (position, color) in enumerate(zip(points.positions[seen], points.colors[seen], strict=True)):
            model.add_point3D(position, pycolmap.Track([pycolmap.TrackElement(index + 1, row)]), color)
    sparse = folder / SPARSE_FOLDER
    sparse.mkdir(parents=True)
    model.write(str(sparse))
    for split, names in _names_by_split(images, "").items():
        (folder / f"{split}_list.txt").write_text("".join(f"{name}\n" for name in names), "utf8")


def _write_transforms(folder: Path, images: Sequence[PlacedImage], points: ObservedPoints) -> None:
    """Write ``transforms.json`` and ``points.ply``, as Nerfstudio's ``nerfstudio`` dataparser reads them.

    Poses are camera-to-world with OpenGL camera axes, in the same world as ``points.ply``.
    """
    # Imported lazily, because few commands need it.
    import trimesh

    frames = []
    for image in images:
        frame = {
            "file_path": f"{IMAGE_FOLDER}/{image.name}",
            "w": image.camera.width,
            "h": image.camera.height,
            **image.camera.to_transforms(),
            "transform_matrix": (image.camera_to_world @ OPENCV_TO_OPENGL.numpy()).tolist(),
        }
        if image.depth is not None:
            frame["depth_file_path"] = image.depth
        frames.append(frame)
    splits = _names_by_split(images, f"{IMAGE_FOLDER}/")
    meta: dict[str, Any] = {
        "camera_model": images[0].camera.to_transforms()["camera_model"],
        # The world of the poses is the original one. Without this line the framework would guess another.
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": POINTS_FILE,
        **{f"{split}_filenames": names for split, names in splits.items()},
        "frames": frames,
    }
    (folder / TRANSFORMS_FILE).write_text(json.dumps(meta, indent=1) + "\n", "utf8")
    trimesh.PointCloud(points.positions, colors=points.colors).export(folder / POINTS_FILE)


def _names_by_split(images: Sequence[PlacedImage], prefix: str) -> dict[Split, list[str]]:
    """List the images' names by split; an empty dictionary where images are not split.

    A split without images gets those of the other held-out split, because the framework asks for all three.
    """
    names = {split: [prefix + image.name for image in images if image.split == split] for split in SPLITS}
    if not names["train"] or not (names["val"] or names["test"]):
        return {}
    return {**names, "val": names["val"] or names["test"], "test": names["test"] or names["val"]}
