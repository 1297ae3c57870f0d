"""Camera poses from the frames of a video, by COLMAP."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from rich.progress import Progress, TaskID
from torch import Tensor

from aenerf_ns.camera.alignment import Similarity, align, pose_errors, rotation_angle
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.progress import progress_bar
from aenerf_ns.recording.images import read_image, require_8_bits

# Each frame is matched with this number of frames after it, and with the frames 16, 32, ... 1024 after it.
_NUM_NEIGHBORS = 10
# This number of frames, evenly spread, are matched with each other. Without them errors add up along the path, and a
# loop stays open.
_NUM_KEY_FRAMES = 100

# Beyond these errors, a pose is not inaccurate but wrong: COLMAP put the camera elsewhere.
_FLIP_DEGREES = 90.0
_MISPLACED_DEGREES = 5.0
_MISPLACED_EXTENTS = 0.1

_MAX_GAPS_SHOWN = 10


@dataclass(frozen=True)
class EstimatedPoses:
    """The poses that structure from motion finds in a video.

    Attributes:
        frame_times: (N,) times of all frames in nanoseconds.
        trajectory: poses of the frames that the largest model places, camera-to-world, OpenCV camera axes, in a world
            of arbitrary position, orientation and scale.
        camera: intrinsics of the frames, as they were given or as COLMAP estimates them.
        model_sizes: numbers of frames that the models place, the largest first. More than one model means that the
            video fell apart into pieces whose relative poses are not known. COLMAP drops pieces of less than 10 frames.
        num_points: 3D points of the largest model.
        reprojection_error: mean over their observations, in pixels.
        features: median number of features in a frame.
        seconds: how long it took.
    """

    frame_times: NDArray[np.int64]
    trajectory: Trajectory
    camera: CameraIntrinsics
    model_sizes: list[int]
    num_points: int
    reprojection_error: float
    features: float
    seconds: float

    def gaps(self) -> list[tuple[int, int, int]]:
        """Return first time, last time (nanoseconds) and number of frames of every run of frames without a pose."""
        lost = ~np.isin(self.frame_times, self.trajectory.times.numpy())
        edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
        return [
            (int(self.frame_times[first]), int(self.frame_times[end - 1]), int(end - first))
            for first, end in zip(edges[::2], edges[1::2], strict=True)
        ]

    def report(self) -> dict[str, Any]:
        """Return the figures as plain values for JSON."""
        registered, frames = len(self.trajectory), len(self.frame_times)
        return {
            "frames": frames,
            "registered_frames": registered,
            "registered_fraction": registered / frames,
            "model_sizes": self.model_sizes,
            "gaps": [{"start_ns": start, "end_ns": end, "frames": count} for start, end, count in self.gaps()],
            "points": self.num_points,
            "mean_reprojection_error_pixels": self.reprojection_error,
            "median_features": self.features,
            "seconds": self.seconds,
        }

    def summary(self) -> str:
        """Return a line of figures, and a second line that names the times of frames without a pose, if any."""
        pieces = f" in the largest of {len(self.model_sizes)} models" if len(self.model_sizes) > 1 else ""
        line = (
            f"COLMAP: {len(self.trajectory)} of {len(self.frame_times)} frames registered{pieces}, {self.num_points} "
            f"points, reprojection error {self.reprojection_error:.2f} px"
        )
        gaps = [f"{start * 1e-9:.3f} to {end * 1e-9:.3f} s ({count})" for start, end, count in self.gaps()]
        if len(gaps) > _MAX_GAPS_SHOWN:
            gaps = [*gaps[:_MAX_GAPS_SHOWN], f"and {len(gaps) - _MAX_GAPS_SHOWN} more runs"]
        if gaps:
            line += (
                f"\nFrames without a pose: {', '.join(gaps)}. Between registered frames poses are interpolated; before "
                "the first and after the last events are not used."
            )
        return line


def estimate_poses(
    frames: Iterable[Path | NDArray[np.uint8]],
    times: ArrayLike,
    camera: CameraIntrinsics | tuple[int, int],
    source: str | Path,
    seed: int = 0,
) -> EstimatedPoses:
    """Estimate the poses of a video by COLMAP's incremental structure from motion, on the CPU.

    Intrinsics and distortion that are given stay as given. Every frame is matched with its neighbors, and a hundred
    frames with each other. COLMAP runs on one thread, because its results depend on the order in which threads end. So
    a seed gives the same poses again, to the last bit on one machine with one version of COLMAP.

    Args:
        frames: (height, width) gray or (height, width, 3) RGB arrays, or files that hold such pictures, in the order of
            time.
        times: (N,) times in nanoseconds, increasing.
        camera: intrinsics of the frames. Or width and height of the frames in pixels: COLMAP then estimates one focal
            length and the radial distortion k1, and the principal point is the middle of the image.
        source: the file or folder of the frames, for messages.
        seed: of COLMAP's random samples.

    Raises:
        DataError: there are fewer than two frames, a frame is of another size than the camera, the times do not
            increase, or COLMAP places no frames.
    """
    times = np.asarray(times, np.int64)
    if len(times) < 2:
        raise DataError(source, f"{len(times)} frames", "poses can be estimated from two frames or more")
    if (np.diff(times) <= 0).any():
        index = int(np.argmax(np.diff(times) <= 0)) + 1
        raise DataError(source, f"frame {index} is not after the frame before it", "sort the frames by time")
    begin = time.perf_counter()
    given = camera if isinstance(camera, CameraIntrinsics) else None
    size = (camera.width, camera.height) if isinstance(camera, CameraIntrinsics) else camera
    with TemporaryDirectory() as folder, progress_bar() as progress:
        workspace = _Workspace(Path(folder), len(times), seed, progress)
        workspace.add_frames(frames, size, source)
        workspace.find_features(given)
        workspace.match()
        models = workspace.reconstruct(refine_intrinsics=given is None)
        features, pairs = workspace.count_features_and_pairs()
    if not models:
        raise DataError(
            source,
            f"COLMAP places none of {len(times)} frames: they have {features:.0f} features (median), and {pairs} pairs "
            "of frames match",
            "it needs a moving camera and sharp, textured frames: a shorter exposure, a higher frame rate, more pixels",
        )
    model = models[0]
    poses = {
        int(Path(image.name).stem): image.cam_from_world().inverse().matrix()
        for image in model.images.values()
        if image.has_pose
    }
    if given is None:
        (found,) = model.cameras.values()
        focal_length, cx, cy, k1 = (float(value) for value in found.params)
        given = CameraIntrinsics(*size, focal_length, focal_length, cx, cy, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    indices = sorted(poses)
    return EstimatedPoses(
        frame_times=times,
        trajectory=Trajectory(times[indices], torch.from_numpy(np.stack([poses[i] for i in indices])), source),
        camera=given,
        model_sizes=[model.num_reg_images() for model in models],
        num_points=model.num_points3D(),
        reprojection_error=model.compute_mean_reprojection_error(),
        features=features,
        seconds=time.perf_counter() - begin,
    )


def compare_with_truth(estimated: Trajectory, truth: Tensor) -> tuple[Trajectory, dict[str, float]]:
    """Map estimated poses to the true world by one Sim(3), and compute their errors.

    Only position, orientation and scale of the whole world are taken from the truth. The similarity aligns positions
    and orientations (:func:`~aenerf_ns.camera.alignment.align`) of the frames that agree with most other frames. So a
    few misplaced frames do not turn the world away from the rest. All frames are mapped, and none is removed.

    Args:
        estimated: the estimated poses.
        truth: (N, 3, 4) true poses at the same times, with the same camera axes.

    Returns:
        The mapped trajectory, and its errors in the units of the truth. The errors of
        :func:`~aenerf_ns.camera.alignment.pose_errors` follow another alignment, of all frames. The others are those of
        the mapped trajectory: medians and maxima of rotation and translation error; the number of ``misplaced_frames``
        (off by more than 5 degrees or a tenth of the extent) and of ``flipped_frames`` (off by more than 90 degrees).
        ``extent`` is the root mean square distance of the true positions from their mean.
    """
    poses, truth = estimated.camera_to_worlds, truth.double()
    extent = Trajectory(estimated.times, truth).extent
    aligned = _align_majority(poses, truth)(poses)
    degrees = torch.rad2deg(rotation_angle(aligned, truth))
    distances = (aligned - truth)[..., 3].norm(dim=-1)
    misplaced = (degrees > _MISPLACED_DEGREES) | (distances > _MISPLACED_EXTENTS * extent)
    return Trajectory(estimated.times, aligned, estimated.source), {
        **pose_errors(aligned, truth),
        "median_rotation_error_degrees": float(degrees.median()),
        "median_translation_error": float(distances.median()),
        "largest_rotation_error_degrees": float(degrees.max()),
        "largest_translation_error": float(distances.max()),
        "extent": extent,
        "misplaced_frames": int(misplaced.sum()),
        "flipped_frames": int((degrees > _FLIP_DEGREES).sum()),
    }


def _align_majority(poses: Tensor, truth: Tensor) -> Similarity:
    """Align the frames that agree on the world's orientation if they are the majority, else all frames."""
    # Each frame alone gives an orientation of the world.
    turns = truth[..., :3] @ poses[..., :3].mT
    degrees = torch.rad2deg(torch.stack([rotation_angle(turns, turn.expand_as(turns)) for turn in turns]))
    agree = degrees[degrees.median(1).values.argmin()] <= _MISPLACED_DEGREES
    if 2 * agree.sum() <= len(poses):
        return align(poses, truth)
    return align(poses[agree], truth[agree])


class _Workspace:
    """COLMAP's database and images in a folder, and the steps of its work."""

    def __init__(self, folder: Path, num_frames: int, seed: int, progress: Progress) -> None:
        self._folder, self._images, self._database = folder, folder / "images", folder / "database.db"
        self._images.mkdir()
        self._names = [f"{index:08d}.png" for index in range(num_frames)]
        self._seed = seed
        self._progress = progress

    def add_frames(self, frames: Iterable[Path | NDArray[np.uint8]], size: tuple[int, int], source: str | Path) -> None:
        """Write the frames as image files for COLMAP."""
        named = zip(self._names, frames, strict=True)
        for name, frame in self._progress.track(named, total=len(self._names), description="Collecting frames"):
            origin = frame if isinstance(frame, Path) else f"{source}, frame {int(Path(name).stem)}"
            with read_image(frame) if isinstance(frame, Path) else Image.fromarray(frame) as image:
                if image.size != size:
                    raise DataError(
                        origin,
                        f"the frame has {image.width} x {image.height} pixels, its camera {size[0]} x {size[1]}",
                        "give the intrinsics of the frames as they are",
                    )
                require_8_bits(image, origin)
                image.convert("L" if image.mode == "L" else "RGB").save(self._images / name)

    def find_features(self, camera: CameraIntrinsics | None) -> None:
        import pycolmap

        reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
        if camera is None:
            reader.camera_model = "SIMPLE_RADIAL"
        else:
            reader.camera_model, parameters = camera.to_colmap()
            reader.camera_params = ", ".join(map(repr, parameters))
        extraction.use_gpu, extraction.num_threads = False, 1
        # COLMAP's own limits suit photographs of many megapixels. This one, and those of the mapper below, suit frames
        # of a fraction of a megapixel.
        extraction.sift.peak_threshold = 0.004
        with self._step("Finding features"):
            pycolmap.extract_features(
                self._database,
                self._images,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )

    def match(self) -> None:
        import pycolmap

        pairs = [f"{self._names[i]} {self._names[j]}" for i, j in _choose_pairs(len(self._names))]
        matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
        verification = pycolmap.TwoViewGeometryOptions()
        matching.use_gpu, matching.num_threads = False, 1
        pairing.match_list_path = self._folder / "pairs.txt"
        pairing.match_list_path.write_text("\n".join(pairs), encoding="utf-8")
        verification.ransac.random_seed = self._seed
        with self._step("Matching frames"):
            pycolmap.match_image_pairs(self._database, matching, pairing, verification, device=pycolmap.Device.cpu)

    def reconstruct(self, refine_intrinsics: bool) -> list[Any]:
        """Return the models, in the order of the number of frames that they place, the largest first."""
        import pycolmap

        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self._seed
        options.num_threads = options.mapper.num_threads = 1
        options.ba_refine_focal_length = options.ba_refine_extra_params = refine_intrinsics
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine_intrinsics
        options.mapper.abs_pose_min_num_inliers, options.mapper.init_min_num_inliers = 15, 50
        options.extract_colors = False
        output = self._folder / "models"
        output.mkdir()
        with self._step("Placing frames", len(self._names)) as task:
            models = pycolmap.incremental_mapping(
                self._database, self._images, output, options, next_image_callback=lambda: self._progress.advance(task)
            )
        return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)

    def count_features_and_pairs(self) -> tuple[float, int]:
        """Return the median number of features in a frame, and the number of pairs of frames that match."""
        import pycolmap

        with contextlib.closing(pycolmap.Database.open(self._database)) as database:
            counts = [database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()]
            return statistics.median(counts) if counts else 0.0, database.num_verified_image_pairs()

    @contextlib.contextmanager
    def _step(self, description: str, total: int | None = None) -> Iterator[TaskID]:
        """Show the progress of a step, and keep COLMAP's log off the console."""
        import pycolmap

        level = pycolmap.logging.minloglevel
        pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
        task = self._progress.add_task(description, total=total)
        try:
            yield task
        finally:
            pycolmap.logging.minloglevel = level
            self._progress.update(task, total=len(self._names), completed=len(self._names))


def _choose_pairs(num_frames: int) -> list[tuple[int, int]]:
    """Return which frames of a video to match: pairs of indices, the smaller index first."""
    offsets = [*range(1, _NUM_NEIGHBORS + 1), *(2**power for power in range(4, 11))]
    pairs = {(i, i + offset) for offset in offsets for i in range(num_frames - offset)}
    keys = sorted({round(k) for k in np.linspace(0, num_frames - 1, min(num_frames, _NUM_KEY_FRAMES))})
    pairs |= {(i, j) for i in keys for j in keys if i < j}
    return sorted(pairs)
