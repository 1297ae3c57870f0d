"""A mesh of a trained run, in the world and the units of the recording, by Open3D's TSDF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.placing import corrected_poses
from aenerf_ns.export.rendering import render
from aenerf_ns.export.times import spread_times
from aenerf_ns.open3d_import import load_open3d
from aenerf_ns.progress import progress_bar

# Of an unbounded scene, the share of what the views see that lies beyond each end of the box, along each axis.
_LEFT_OUT = 0.01
# Voxels on either side of a surface in which its distance is kept.
_TRUNCATION = 4.0
# Voxels along a side of a block, and blocks that memory is taken for at first: 0.4 GB.
_BLOCK, _NUM_BLOCKS = 8, 40_000
# Views that must have seen a surface.
_LEAST_VIEWS = 1.0


@dataclass(frozen=True)
class ColoredMesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float64 in the recording's world and units.
        faces: (F, 3) indices of vertices.
        colors: (V, 3) uint8 display values.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8]


def extract_mesh(run: TrainedRun, num_views: int, resolution: int) -> ColoredMesh:
    """Fuse the depths of views along the corrected trajectory in a truncated signed distance field, and mesh it.

    The framework's own exporter takes the cameras as the dataset gives them, while its renderings are from the
    corrected poses. Its field also forgets: a voxel holds the mean of its last two views or so, and the mesh is rough.

    Args:
        run: in evaluation mode.
        num_views: evenly spread over the time of the run.
        resolution: voxels along the longest side of the box that is meshed: the scene's own box where the dataset
            states one, else a box that holds nearly all that the views see.

    Raises:
        DataError: the views see no surface.
    """
    open3d = load_open3d()
    given = run.recording.event_camera
    lens = CameraIntrinsics(given.width, given.height, given.fx, given.fy, given.cx, given.cy)
    poses = homogeneous(corrected_poses(run, spread_times(run.scene.window, num_views)))
    colors, depths = _views(run, lens, poses)
    directions, _ = lens.pixel_directions()
    # From OpenGL's axes to OpenCV's.
    in_camera = torch.from_numpy(directions) * torch.tensor([1.0, -1.0, -1.0])
    points = poses[:, None, None, :3, 3] + depths[..., None] * torch.einsum(
        "nij,hwj->nhwi", poses[:, :3, :3], in_camera
    )
    low, high = _box(run, points[depths > 0].numpy())
    depths[((points < torch.from_numpy(low)) | (points > torch.from_numpy(high))).any(-1)] = 0
    voxel = float((high - low).max()) / resolution
    core, image = open3d.core, open3d.t.geometry.Image
    # Blocks are only kept around surfaces. Open3D's other sparse volume finds no block in some of its releases.
    grid = open3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel,
        block_resolution=_BLOCK,
        block_count=_NUM_BLOCKS,
    )
    # Open3D counts pixels from the centre of the first one.
    matrix = core.Tensor(np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]]))
    along_axis = (depths * in_camera[..., 2]).float().numpy()
    farthest = 2 * float(along_axis.max()) + 1
    for color, depth, pose in zip(colors, along_axis, poses.numpy(), strict=True):
        if not depth.any():
            continue
        seen, shown, extrinsics = image(core.Tensor(depth)), image(core.Tensor(color)), core.Tensor(np.linalg.inv(pose))
        blocks = grid.compute_unique_block_coordinates(seen, matrix, extrinsics, 1.0, farthest, _TRUNCATION)
        grid.integrate(blocks, seen, shown, matrix, matrix, extrinsics, 1.0, farthest, _TRUNCATION)
    mesh = grid.extract_triangle_mesh(weight_threshold=_LEAST_VIEWS)
    if len(mesh.triangle.indices) == 0:
        raise _no_surface(run)
    return ColoredMesh(
        mesh.vertex.positions.numpy().astype(np.float64),
        mesh.triangle.indices.numpy().astype(np.int64),
        np.rint(255 * mesh.vertex.colors.numpy().clip(0, 1)).astype(np.uint8),
    )


def _views(run: TrainedRun, lens: CameraIntrinsics, poses: Tensor) -> tuple[NDArray[np.float32], Tensor]:
    """Return display values (N, H, W, 3), and float64 distances (N, H, W) along the rays in units of the recording."""
    colors, depths = [], []
    with progress_bar() as progress:
        task = progress.add_task("Rendering views", total=len(poses))
        for pose in poses:
            outputs = render(run, lens, pose)
            colors.append(outputs["rgb"].clamp(0, 1).float().cpu().numpy())
            depths.append(outputs["depth"][..., 0].double().cpu())
            progress.advance(task)
    return np.stack(colors), torch.stack(depths)


def _box(run: TrainedRun, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest corner (3,) of the box that is meshed, in the recording's world.

    Args:
        run: trained.
        points: (N, 3) that the views see.
    """
    if len(points) == 0:
        raise _no_surface(run)
    stated = run.recording.scene_box
    if stated is not None:
        low, high = stated.double().numpy()
        return low, high
    low, high = np.quantile(points, [_LEFT_OUT, 1 - _LEFT_OUT], axis=0)
    margin = _LEFT_OUT * (high - low).max()
    return low - margin, high + margin


def _no_surface(run: TrainedRun) -> DataError:
    return DataError(run.data, "the run renders no surface", "train it longer")
