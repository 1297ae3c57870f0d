"""COLMAP's work on the frames of a video: features, matches and models."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import statistics
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import numpy as np
import pycolmap
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress, TaskID

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.pose_estimation.colmap_model import MIN_POINTS, intrinsics_of, is_placed, placed_images, poses_of
from aenerf_ns.recording.images import read_image, require_8_bits

# Each frame is matched with this number of frames after it, and with the frames 16, 32, ... 1024 after it.
_NUM_NEIGHBORS = 10
# This number of frames, evenly spread, are matched with each other. Without them errors add up along the path, and a
# loop stays open.
_NUM_KEY_FRAMES = 100
# Files that are kept if a command is interrupted.
_DATABASE, _INPUTS = "database.db", "inputs.txt"
# Relative change of the cost at which an adjustment ends. With COLMAP's own, 0, each one takes all its iterations.
_TOLERANCE = 1e-4
# Pixels that a match may be off.
_MAX_EPIPOLAR_ERROR = 1.0


@contextlib.contextmanager
def work_folder(kept: Path | None) -> Iterator[Path]:
    """Yield a temporary folder for a :class:`ColmapWorkspace`.

    Args:
        kept: where the features and matches are kept if the command is interrupted, and where they are then found. The
            folder is removed when the work ends or the data are bad. Another error, such as a full disk, leaves it.
    """
    with TemporaryDirectory() as name:
        folder = Path(name)
        if kept is not None and kept.is_dir():
            shutil.copytree(kept, folder, dirs_exist_ok=True)
        is_kept = False
        try:
            yield folder
        except (KeyboardInterrupt, SystemExit):
            if kept is not None and (folder / _DATABASE).exists():
                is_kept = True
                kept.mkdir(exist_ok=True)
                # It comes last: a database without it, cut short by another interrupt, is not taken.
                (kept / _INPUTS).unlink(missing_ok=True)
                for file in (_DATABASE, _INPUTS):
                    shutil.copyfile(folder / file, kept / file)
                words = f"{kept} keeps the features and matches that were found: repeat the command to go on."
                CONSOLE.print(words, markup=False, highlight=False, soft_wrap=True)
            raise
        except Exception as error:
            is_kept = not isinstance(error, DataError)
            raise
        finally:
            if kept is not None and not is_kept:
                shutil.rmtree(kept, ignore_errors=True)


class ColmapWorkspace:
    """COLMAP's database and images in a folder, and the steps of its work.

    Features and matches that earlier work on the same frames left in the folder are taken.
    Features are found and matched on all cores. Each other step runs on one thread, because its results would depend on
    the order in which threads end.

    Args:
        folder: see :func:`work_folder`.
        num_frames: number of frames.
        seed: of COLMAP's random samples.
        progress: shows each step.
        min_motion: pixels that a feature must have moved, or its match is left out.

    Attributes:
        held_out: matches that no model is made of: the COLMAP indices of two frames, and the (M, 2) rays of the matched
            features in each, as points in the plane at depth 1.
    """

    def __init__(self, folder: Path, num_frames: int, seed: int, progress: Progress, min_motion: float = 0.0) -> None:
        self._folder, self._images, self._database = folder, folder / "images", folder / _DATABASE
        self._pairs = folder / "pairs.txt"
        self._images.mkdir()
        self._content = hashlib.sha256()
        # COLMAP's log would break the progress bars.
        pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
        self._names = [f"{index:08d}.png" for index in range(num_frames)]
        # COLMAP's seeds have 31 bits.
        self._seed = seed % 2**31
        self._progress = progress
        self._min_motion = min_motion
        self.held_out: list[tuple[tuple[int, int], list[NDArray[np.float64]]]] = []
        # Pixels in a unit of the plane at depth 1, where the held-out matches are.
        self._scales: list[NDArray[np.float64]] = []

    def add_frames(self, frames: Iterable[Path | NDArray[np.uint8]], size: tuple[int, int], source: str | Path) -> None:
        """Write the frames as image files for COLMAP."""
        named = zip(self._names, frames, strict=True)
        for name, frame in self._progress.track(named, total=len(self._names), description="Collecting frames"):
            origin = frame if isinstance(frame, Path) else f"{source}, frame {int(Path(name).stem)}"
            with read_image(frame) if isinstance(frame, Path) else Image.fromarray(frame) as image:
                if image.size != size:
                    problem = f"the frame has {image.width} x {image.height} pixels, its camera {size[0]} x {size[1]}"
                    raise DataError(origin, problem, "give the intrinsics of the frames as they are")
                require_8_bits(image, origin)
                image.convert("L" if image.mode == "L" else "RGB").save(self._images / name)
            self._content.update((self._images / name).read_bytes())

    def find_features(self, camera: CameraIntrinsics | None) -> None:
        """Find the features of the frames, unless earlier work on the same frames found them. Other work is removed."""
        versions = f"aenerf-ns {version('aenerf-ns')}, pycolmap {pycolmap.__version__}"
        inputs = f"{versions}, seed {self._seed}, motion {self._min_motion}, {camera}, {self._content.hexdigest()}"
        stated = self._folder / _INPUTS
        if not stated.exists() or stated.read_text("utf8") != inputs:
            self._database.unlink(missing_ok=True)
            stated.write_text(inputs, "utf8")
        reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
        if camera is None:
            reader.camera_model = "SIMPLE_RADIAL"
        else:
            reader.camera_model, parameters = camera.to_colmap()
            reader.camera_params = ", ".join(map(repr, parameters))
        extraction.use_gpu = False
        # COLMAP's own limits suit photographs of many megapixels. This one, and those of the mapper below, suit frames
        # of a fraction of a megapixel.
        extraction.sift.peak_threshold = 0.004
        with self._step("Finding features"):
            # The numbers of the images would depend on the order in which threads end.
            pycolmap.Database.open(self._database).close()
            pycolmap.import_images(self._database, self._images, camera_mode=pycolmap.CameraMode.SINGLE, options=reader)
            pycolmap.extract_features(
                self._database,
                self._images,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )

    def match(self) -> None:
        pairs = [f"{self._names[i]} {self._names[j]}" for i, j in _choose_pairs(len(self._names))]
        matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
        verification = self._verification()
        matching.use_gpu = False
        pairing.match_list_path = self._pairs
        self._pairs.write_text("\n".join(pairs), encoding="utf-8")
        with self._step("Matching frames"):
            pycolmap.match_image_pairs(self._database, matching, pairing, verification, device=pycolmap.Device.cpu)
        # Later steps change the database. An interrupted command goes on from the one without their changes.
        self._database = Path(shutil.copy(self._database, self._folder / "models.db"))

    def estimate_intrinsics(self, rounds: Iterable[tuple[float, float, float]]) -> CameraIntrinsics | None:
        """Estimate one focal length and the radial distortion k1 from all matches, and use them from here on.

        Args:
            rounds: limits of the adjustments, as :meth:`adjust` takes them.

        Returns:
            The intrinsics; None where the frames cannot be placed.
        """
        models = self.reconstruct(refine_intrinsics=True)
        if not models:
            return None
        model = models[0]
        for limits in rounds:
            self._store_intrinsics(model)
            adjusted = self.adjust(model, *limits, refine_intrinsics=True)
            if not is_placed(adjusted):
                break
            model = adjusted
        self._store_intrinsics(model)
        with pycolmap.Database.open(self._database) as database:
            database.clear_two_view_geometries()
        with self._step("Verifying matches"):
            pycolmap.verify_matches(self._database, self._pairs, self._verification())
        return intrinsics_of(model)

    def _store_intrinsics(self, model: Any) -> None:
        (camera,) = model.cameras.values()
        camera.has_prior_focal_length = True
        with pycolmap.Database.open(self._database) as database:
            database.update_camera(camera)

    def _verification(self) -> Any:
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = self._seed
        options.filter_stationary_matches = self._min_motion > 0
        options.stationary_matches_max_error = self._min_motion
        return options

    def hold_out_matches(self, share: float) -> None:
        """Take the matches of a share of the pairs of frames out of the database, to judge models by."""
        with pycolmap.Database.open(self._database) as database:
            camera = database.read_all_cameras()[0]
            self.held_out, self._scales = [], []
            pair_ids, geometries = database.read_two_view_geometries()
            chosen = np.random.default_rng(self._seed).random(len(pair_ids)) < share
            for pair_id, geometry, is_chosen in zip(pair_ids, geometries, chosen, strict=True):
                if not is_chosen or len(geometry.inlier_matches) == 0:
                    continue
                images = pycolmap.pair_id_to_image_pair(pair_id)
                pixels = [
                    np.asarray(database.read_keypoints(image), np.float64)[rows, :2]
                    for image, rows in zip(images, geometry.inlier_matches.T, strict=True)
                ]
                self.held_out.append((images, [camera.cam_from_img(ends) for ends in pixels]))
                self._scales.append(np.sqrt(np.prod([_pixels_in_a_unit(camera, ends) for ends in pixels], 0)))
                database.delete_two_view_geometry(*images)
                database.delete_matches(*images)

    def agreement(self, model: Any) -> float | None:
        """Return the share of the held-out matches that fit the poses of a model; those of frames without one do not.

        None where there are no matches. A match fits if its epipolar error (Sampson's distance) is less than a pixel.
        """
        poses = {image.image_id: image.cam_from_world() for image in placed_images(model)}
        fitting = total = 0
        for ((first, second), rays), scale in zip(self.held_out, self._scales, strict=True):
            total += len(rays[0])
            if first not in poses or second not in poses:
                continue
            essential = pycolmap.essential_matrix_from_pose(poses[second] * poses[first].inverse())
            errors = np.sqrt(pycolmap.compute_squared_sampson_error(rays[0], rays[1], essential))
            fitting += int((errors * scale < _MAX_EPIPOLAR_ERROR).sum())
        return fitting / total if total else None

    def reconstruct(self, refine_intrinsics: bool = False, start: Any = None) -> list[Any]:
        """Return the models of the incremental mapper, in the order of the number of frames, the largest first.

        Args:
            refine_intrinsics: whether to estimate focal length and distortion too.
            start: a model that gets the frames that it lacks, and is the only one returned.
        """
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self._seed
        options.num_threads = options.mapper.num_threads = 1
        options.ba_refine_focal_length = options.ba_refine_extra_params = refine_intrinsics
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine_intrinsics
        options.mapper.abs_pose_min_num_inliers, options.mapper.init_min_num_inliers = MIN_POINTS, 50
        options.extract_colors = False
        options.ba_global_function_tolerance = _TOLERANCE
        output, begun = self._new_folder(), None
        if start is not None:
            options.multiple_models, begun = False, self._new_folder()
            start.write(begun)
        with self._step("Placing frames", len(self._names)) as task:
            advance = partial(self._progress.advance, task)
            models = pycolmap.incremental_mapping(
                self._database, self._images, output, options, begun or "", next_image_callback=advance
            )
        return _largest_first(models)

    def reconstruct_globally(self) -> list[Any]:
        """Return the models of the global mapper (GLOMAP), the largest first. The intrinsics stay as given."""
        options = pycolmap.GlobalPipelineOptions()
        mapper = options.mapper
        options.random_seed = mapper.random_seed = mapper.retriangulation.random_seed = self._seed
        mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = self._seed
        options.num_threads = mapper.num_threads = 1
        mapper.global_positioning.use_gpu = False
        _keep_intrinsics(mapper.bundle_adjustment)
        output = self._new_folder()
        with self._step("Placing all frames at once"):
            models = pycolmap.global_mapping(self._database, self._images, output, options)
        return _largest_first(models)

    def triangulate(self, poses: Mapping[int, NDArray[np.float64]], max_pixels: float, max_degrees: float) -> Any:
        """Return the model of all matches between frames of given poses.

        Args:
            poses: (3, 4) camera-to-world, OpenCV camera axes, by the index of the frame.
            max_pixels: reprojection error beyond which an observation belongs to no point.
            max_degrees: the same as an angle between rays.
        """
        with pycolmap.Database.open(self._database) as database:
            numbers = {image.name: image.image_id for image in database.read_all_images()}
            (camera,) = database.read_all_cameras()
        posed = pycolmap.Reconstruction()
        posed.add_camera_with_trivial_rig(camera)
        for index, pose in poses.items():
            name = self._names[index]
            image = pycolmap.Image(name=name, image_id=numbers[name], camera_id=camera.camera_id)
            posed.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose).inverse())
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = options.triangulation.random_seed = self._seed
        options.num_threads, options.extract_colors = 1, False
        limits = options.triangulation
        options.mapper.filter_max_reproj_error = limits.complete_max_reproj_error = max_pixels
        limits.merge_max_reproj_error = max_pixels
        limits.create_max_angle_error = limits.continue_max_angle_error = max_degrees
        with self._step("Triangulating tracks"):
            posed = pycolmap.triangulate_points(
                posed, self._database, self._images, self._new_folder(), clear_points=True, options=options
            )
            pycolmap.ObservationManager(posed).filter_observations_with_negative_depth()
        return posed

    def adjust(
        self, model: Any, max_pixels: float, max_degrees: float, loss_scale: float, refine_intrinsics: bool = False
    ) -> Any:
        """Triangulate all matches again from the poses of a model, and adjust poses and points to them.

        Args:
            model: its poses.
            max_pixels, max_degrees: see :meth:`triangulate`.
            loss_scale: pixels beyond which an observation counts less, as tracks of images of events are often wrong.
            refine_intrinsics: whether to adjust focal length and distortion too.
        """
        posed = self.triangulate(poses_of(model, only_linked=False), max_pixels, max_degrees)
        adjustment = pycolmap.BundleAdjustmentOptions()
        _keep_intrinsics(adjustment)
        adjustment.refine_focal_length = adjustment.refine_extra_params = refine_intrinsics
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = loss_scale
        config = pycolmap.BundleAdjustmentConfig()
        for image in posed.images:
            config.add_image(image)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        with self._step("Adjusting poses to all tracks"):
            # pycolmap.bundle_adjustment does the same, but it turns COLMAP's log on.
            pycolmap.create_default_bundle_adjuster(adjustment, config, posed).solve()
        return posed

    def _new_folder(self) -> Path:
        return Path(mkdtemp(dir=self._folder))

    def count_features_and_pairs(self) -> tuple[float, int]:
        """Return the median number of features in a frame, and the number of pairs of frames that match."""
        with pycolmap.Database.open(self._database) as database:
            counts = [database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()]
            # COLMAP's own count has the pairs without a match too.
            return statistics.median(counts) if counts else 0.0, len(database.read_two_view_geometry_num_inliers()[0])

    @contextlib.contextmanager
    def _step(self, description: str, total: int | None = None) -> Iterator[TaskID]:
        """Show the progress of a step."""
        task = self._progress.add_task(description, total=total)
        try:
            yield task
        finally:
            self._progress.update(task, total=len(self._names), completed=len(self._names))


def _choose_pairs(num_frames: int) -> list[tuple[int, int]]:
    """Return which frames of a video to match: pairs of indices, the smaller index first."""
    offsets = [*range(1, _NUM_NEIGHBORS + 1), *(2**power for power in range(4, 11))]
    pairs = {(i, i + offset) for offset in offsets for i in range(num_frames - offset)}
    keys = sorted({round(k) for k in np.linspace(0, num_frames - 1, min(num_frames, _NUM_KEY_FRAMES))})
    pairs |= {(i, j) for i in keys for j in keys if i < j}
    return sorted(pairs)


def _pixels_in_a_unit(camera: Any, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many pixels a unit of the plane at depth 1 has at (N, 2) pixels.

    Without a distortion it is the focal length. A fisheye lens stretches the plane several times towards the edges.
    """
    steps = [camera.cam_from_img(pixels + step) - camera.cam_from_img(pixels) for step in np.eye(2)]
    return np.abs(np.linalg.det(np.stack(steps, -1))) ** -0.5


def _largest_first(models: dict[int, Any]) -> list[Any]:
    return sorted(filter(is_placed, models.values()), key=lambda model: model.num_reg_images(), reverse=True)


def _keep_intrinsics(adjustment: Any) -> None:
    """Let a bundle adjustment leave the intrinsics as they are, and run on one thread of the CPU until it is done."""
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = adjustment.print_summary = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.ceres.solver_options.function_tolerance = _TOLERANCE
