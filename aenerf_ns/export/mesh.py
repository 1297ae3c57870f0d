"""A mesh of a trained run, in the world and the units of the recording, by Open3D's TSDF."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from aenerf_ns.camera.image_encoding import ImageEncoding, decode, encode
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export.rendering import corrected_poses, render
from aenerf_ns.export.times import spread_times
from aenerf_ns.open3d_import import load_open3d
from aenerf_ns.progress import track

# Share of what the views see of an unbounded scene that lies beyond each end of the box, along each axis.
_MAX_BEYOND = 0.01
# Voxels on either side of a surface in which its distance is kept.
_TRUNCATION = 4.0
# Voxels along a side of a block, and blocks that memory is taken for at first: 0.4 GB.
_BLOCK, _NUM_BLOCKS = 8, 40_000
# Open3D keeps what more views than this have seen.
_MIN_VIEWS = 1.0


def extract_mesh(run: TrainedRun, num_views: int, resolution: int, encoding: ImageEncoding = "srgb") -> trimesh.Trimesh:
    """Fuse the depths of views along the corrected trajectory in a truncated signed distance field, and mesh it.

    The field of the framework's own exporter forgets: a voxel holds the mean of its last two views or so, and the mesh
    is rough.

    Args:
        run: in evaluation mode.
        num_views: evenly spread over the time of the run, two or more.
        resolution: voxels along the longest side of the box that is meshed: the dataset's scene box where it states
            one, else a box that holds nearly all that the views see.
        encoding: of the mesh's colors.

    Returns:
        A mesh with vertex colors, in the recording's world and units.

    Raises:
        DataError: the views see no surface, or no two of them the same one, or the scene lies too far from the origin.
    """
    open3d = load_open3d()
    given = run.recording.event_camera
    camera = CameraIntrinsics(given.width, given.height, given.fx, given.fy, given.cx, given.cy)
    poses = corrected_poses(run, spread_times(run.scene.window, num_views))
    colors, distances = [], []
    for pose in track(poses, "Rendering views"):
        outputs = render(run, camera, pose)
        colors.append(outputs["rgb"].clamp(0, 1).float().cpu().numpy())
        distances.append(outputs["depth"][..., 0].double().cpu())
    depths = torch.stack(distances)
    directions, _ = camera.pixel_directions()
    # From OpenGL's axes to OpenCV's.
    in_camera = torch.from_numpy(directions) * torch.tensor([1.0, -1.0, -1.0])
    points = poses[:, None, None, :3, 3] + depths[..., None] * torch.einsum(
        "nij,hwj->nhwi", poses[:, :3, :3], in_camera
    )
    if not (depths > 0).any():
        raise DataError(run.data, "the run renders no surface", "train it longer")
    low, high = _choose_box(run, points[depths > 0].numpy())
    depths[((points < torch.from_numpy(low)) | (points > torch.from_numpy(high))).any(-1)] = 0
    voxel = float((high - low).max()) / resolution
    # Open3D and mesh files hold single precision, which cannot tell voxels apart there.
    farthest_corner = np.float32(np.abs([low, high]).max())
    if np.spacing(farthest_corner) > voxel / 8:
        problem = f"its scene lies {farthest_corner:.3g} units from the origin of its world, too far for a mesh"
        raise DataError(run.data, problem, "subtract a constant from the positions of its poses, and train again")
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
    # Open3D counts pixels from the center of the first one.
    matrix = core.Tensor(np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]]))
    along_axis = (depths * in_camera[..., 2]).float().numpy()
    farthest = 2 * float(along_axis.max()) + 1
    for color, depth, pose in zip(colors, along_axis, poses.numpy(), strict=True):
        # Open3D looks at every fourth pixel, and fails where these see nothing.
        if not depth[::4, ::4].any():
            continue
        seen, shown, extrinsics = image(core.Tensor(depth)), image(core.Tensor(color)), core.Tensor(np.linalg.inv(pose))
        blocks = grid.compute_unique_block_coordinates(seen, matrix, extrinsics, 1.0, farthest, _TRUNCATION)
        grid.integrate(blocks, seen, shown, matrix, matrix, extrinsics, 1.0, farthest, _TRUNCATION)
    mesh = grid.extract_triangle_mesh(weight_threshold=_MIN_VIEWS)
    if len(mesh.triangle.indices) == 0:
        problem = f"no two of {num_views} views see the same surface in voxels of {voxel:.3g} units"
        raise DataError(run.data, problem, "give a higher --num-views or --resolution, or train it longer")
    displayed = torch.from_numpy(mesh.vertex.colors.numpy()).clamp(0, 1)
    shown = encode(decode(displayed, run.recording.image_encoding), encoding)
    return trimesh.Trimesh(
        mesh.vertex.positions.numpy().astype(np.float64),
        mesh.triangle.indices.numpy().astype(np.int64),
        vertex_colors=np.rint(255 * shown.numpy()).astype(np.uint8),
        process=False,
    )


def _choose_box(run: TrainedRun, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest corner (3,) of the box to mesh: the dataset's, else that of (N, 3) points."""
    stated = run.recording.scene_box
    if stated is not None:
        low, high = stated.double().numpy()
        return low, high
    low, high = np.quantile(points, [_MAX_BEYOND, 1 - _MAX_BEYOND], axis=0)
    margin = _MAX_BEYOND * (high - low).max()
    return low - margin, high + margin
