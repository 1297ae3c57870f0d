"""Cameras for other trainers: read back by pycolmap and by the framework's own dataparsers."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.export.camera_model_files import ObservedPoints, PlacedImage, write_cameras
from aenerf_ns.open3d_import import load_open3d

# By the name of COLMAP's model.
LENSES = {
    "PINHOLE": CameraIntrinsics(64, 48, 50.0, 51.0, 31.5, 24.5),
    "OPENCV": CameraIntrinsics(64, 48, 50.0, 51.0, 31.5, 24.5, distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.0)),
    "FULL_OPENCV": CameraIntrinsics(64, 48, 50.0, 51.0, 31.5, 24.5, distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "OPENCV_FISHEYE": CameraIntrinsics(64, 48, 50.0, 51.0, 31.5, 24.5, "fisheye", (0.01, -0.02, 0.003, 0.001)),
}
SPLITS = ("train", "train", "train", "val", "test", "test", "train", "train")


def write(folder: Path, lens: CameraIntrinsics, random_poses: torch.Tensor) -> tuple[list[PlacedImage], ObservedPoints]:
    """Writes images of one lens at random poses, each with the points at two distances along five of its pixels."""
    images = [
        PlacedImage(f"some/{index:03d}.png", lens, np.vstack([pose, [0, 0, 0, 1]]), split)
        for index, (pose, split) in enumerate(zip(random_poses.numpy(), SPLITS, strict=True))
    ]
    generator = np.random.default_rng(0)
    directions, _ = lens.pixel_directions()
    positions, pixels, indices = [], [], []
    for index, image in enumerate(images):
        rows, columns = generator.integers(0, 48, 5), generator.integers(0, 64, 5)
        # From OpenGL's axes to OpenCV's.
        in_camera = generator.uniform(1, 3, (5, 1)) * directions[rows, columns] * [1, -1, -1]
        positions.append(in_camera @ image.camera_to_world[:3, :3].T + image.camera_to_world[:3, 3])
        pixels.append(np.stack([columns + 0.5, rows + 0.5], -1))
        indices.append(np.full(5, index))
    colors = generator.integers(0, 256, (40, 3)).astype(np.uint8)
    points = ObservedPoints(np.concatenate(positions), colors, np.concatenate(indices), np.concatenate(pixels))
    write_cameras(folder, images, points)
    return images, points


@pytest.mark.parametrize("name", LENSES)
def test_pycolmap_reads_the_model(name: str, tmp_path: Path, random_poses: torch.Tensor) -> None:
    images, points = write(tmp_path, LENSES[name], random_poses)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert [model.images[index + 1].name for index in range(8)] == [image.name for image in images]
    assert {camera.model.name for camera in model.cameras.values()} == {name}
    for index, image in enumerate(images):
        pose = model.images[index + 1].cam_from_world().inverse().matrix()
        np.testing.assert_allclose(pose, image.camera_to_world[:3], atol=1e-9)
    # Each point lies where its image shows it, which checks pose, lens and the convention of pixels at once.
    assert model.num_points3D() == 40
    for number, point in model.points3D.items():
        (element,) = point.track.elements
        image = model.images[element.image_id]
        np.testing.assert_allclose(point.xyz, points.positions[number - 1], atol=1e-9)
        np.testing.assert_array_equal(point.color, points.colors[number - 1])
        shown = image.points2D[element.point2D_idx].xy
        np.testing.assert_array_equal(shown, points.pixels[number - 1])
        np.testing.assert_allclose(image.project_point(point.xyz), shown, atol=1e-6)


def assert_read(outputs: DataparserOutputs, images: list[PlacedImage], points: ObservedPoints, folder: Path) -> None:
    """Asserts that a dataparser of the framework gives images, in the world that they were written in."""
    names = [Path(file).relative_to(folder / "images").as_posix() for file in outputs.image_filenames]
    assert names == [image.name for image in images]
    # The inverse of the dataparser's own transform.
    found = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opencv")
    expected = np.stack([image.camera_to_world[:3] for image in images])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    wanted = images[0].camera.cameras(torch.from_numpy(expected))
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(outputs.cameras, name).unique().tolist() == [getattr(images[0].camera, name)], name
    assert torch.equal(outputs.cameras.camera_type, wanted.camera_type)
    distortion = wanted.distortion_params if wanted.distortion_params is not None else torch.zeros(len(images), 6)
    torch.testing.assert_close(outputs.cameras.distortion_params, distortion)
    transform = torch.cat([outputs.dataparser_transform, torch.tensor([[0.0, 0, 0, 1]])])
    in_scene = torch.from_numpy(points.positions).float() @ transform[:3, :3].T + transform[:3, 3]
    torch.testing.assert_close(outputs.metadata["points3D_xyz"], in_scene * outputs.dataparser_scale, atol=1e-5, rtol=0)
    np.testing.assert_array_equal(outputs.metadata["points3D_rgb"], points.colors)


COLMAP = partial(ColmapDataParserConfig, colmap_path=Path("sparse/0"), downscale_factor=1)
NERFSTUDIO = partial(NerfstudioDataParserConfig, load_3D_points=True, downscale_factor=1)


@pytest.mark.parametrize(
    ("dataparser", "lens"),
    [
        *((NERFSTUDIO, lens) for lens in LENSES.values()),
        # The framework refuses COLMAP's only model with k3, and a fourth parameter of a fisheye lens.
        *((COLMAP, LENSES[name]) for name in ("PINHOLE", "OPENCV")),
        (COLMAP, replace(LENSES["OPENCV_FISHEYE"], distortion=(0.01, -0.02, 0.003, 0.0))),
    ],
)
def test_framework_reads_the_cameras(
    dataparser: Callable[..., DataParserConfig], lens: CameraIntrinsics, tmp_path: Path, random_poses: torch.Tensor
) -> None:
    # Points are read by Open3D, which needs a libusb that the system may lack.
    load_open3d()
    images, points = write(tmp_path, lens, random_poses)
    for split in ("train", "val", "test"):
        of_split = [image for image in images if image.split == split]
        assert_read(dataparser(data=tmp_path).setup().get_dataparser_outputs(split), of_split, points, tmp_path)
