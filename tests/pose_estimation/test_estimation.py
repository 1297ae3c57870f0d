"""Poses from frames and from events: what COLMAP makes of a short recording, and the arithmetic around it."""

import contextlib
import dataclasses
import json
import shutil
import sqlite3
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.camera.alignment import Similarity, align, pose_errors
from aenerf_ns.camera.image_encoding import decode
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.cli.check import Check
from aenerf_ns.cli.convert import Convert
from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.pose_estimation.colmap_workspace import ColmapWorkspace, work_folder
from aenerf_ns.pose_estimation.from_events import estimate_poses_from_events
from aenerf_ns.pose_estimation.from_frames import compare_with_truth, estimate_poses
from aenerf_ns.pose_estimation.picture import draw_poses
from aenerf_ns.recording.recording import ReferenceView
from aenerf_ns.recording.scene import SCENE_KEY
from aenerf_ns.recording.views import move_views
from aenerf_ns.simulator.open_scene import open_scene
from aenerf_ns.simulator.paths import RoomPath
from aenerf_ns.simulator.scene import SimulationScene
from aenerf_ns.simulator.simulation import Simulation

FRAME = 40_000_000
SMALL = CameraIntrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)


class FirstSeventh(RoomPath):
    """The first seventh of the loop."""

    def __call__(self, s: float) -> np.ndarray:
        return super().__call__(s / 7)


@pytest.fixture(scope="module")
def room(small_work: None) -> SimulationScene:
    return dataclasses.replace(open_scene("room"), path=FirstSeventh())


@pytest.fixture(scope="module")
def dataset(room: SimulationScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose poses COLMAP estimated from 14 frames."""
    folder = tmp_path_factory.mktemp("colmap") / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("aenerf_ns.simulator.open_scene.open_scene", lambda *_: room)
        Simulate(
            folder, poses="colmap", width=160, height=120, duration=14 / 25 - 0.03, max_displacement=2.0,
            train_images=3, validation_views=1, test_views=1, positive_contrast_threshold=0.12,
            negative_contrast_threshold=0.12,
        ).main()  # fmt: skip
    return folder


def test_colmap_finds_simulated_poses(dataset: Path) -> None:
    report = json.loads((dataset / "poses_report.json").read_text())
    assert report["frames"] == 14
    assert report["registered_frames"] == report["model_sizes"][0] == 14
    assert report["mean_reprojection_error_pixels"] < 1
    # Measured: 0.7 degrees and 8 mm at the frames of a path of 1.1 m; about the same between them.
    for name in ("errors", "errors_between_frames"):
        assert report[name]["rotation_error_degrees"] < 2
        assert report[name]["translation_error"] < 0.03
    errors = report["errors"]
    assert errors["largest_rotation_error_degrees"] < 4
    assert errors["misplaced_frames"] == errors["flipped_frames"] == 0
    assert "14 of 14 frames registered" in report["summary"]
    assert "without a pose" not in report["summary"]
    # The poses are metric.
    estimated, truth = (
        read_tum_trajectory(dataset / f"trajectory_{name}.txt") for name in ("estimated", "ground_truth")
    )
    assert np.diff(estimated.times.numpy()).tolist() == [FRAME] * 13
    assert estimated.start == 1_500_000
    true = truth.interpolate(estimated.times)
    # Neither exact, nor in a world or scale of COLMAP's own.
    error = (estimated.camera_to_worlds - true)[..., 3].norm(dim=-1)
    assert 1e-5 < error.mean() < 0.05 * estimated.extent
    # Events before the first estimated pose and after the last one are not trained on.
    outputs = NativeDataParserConfig(data=dataset).setup().get_dataparser_outputs("train")
    window = outputs.metadata[SCENE_KEY].window
    assert estimated.start <= window.start < window.end == estimated.end < truth.end


@pytest.fixture(scope="module")
def video(room: SimulationScene) -> SimpleNamespace:
    """14 frames with their camera, times in nanoseconds and true poses."""
    camera = CameraIntrinsics(160, 120, *room.intrinsics(160, 120))
    simulation = Simulation(room, camera, SensorModel(), "easy", 14 / 25 - 0.03, 2.0, 0)
    times = simulation.frame_times(25.0, 0.003)
    frames = [simulation.blurred_frame(int(time), 0.003) for time in times]
    truth = torch.stack([simulation.pose(int(time))[:3] for time in times])
    return SimpleNamespace(camera=camera, times=times, frames=frames, truth=truth)


def test_adjustment_reduces_errors(video: SimpleNamespace) -> None:
    errors = []
    for adjusted in (False, True):
        found = estimate_poses(video.frames, video.times, video.camera, "frames", adjusted=adjusted)
        errors.append(compare_with_truth(found.trajectory, video.truth)[1]["rotation_error_degrees"])
        assert ("mapper; " in found.summary()) == adjusted
    # Measured: 0.25 and 0.11 degrees.
    assert errors[1] < 0.6 * errors[0]


def test_colmap_estimates_intrinsics(video: SimpleNamespace) -> None:
    found = estimate_poses(video.frames, video.times, (160, 120), "frames")
    assert len(found.trajectory) == len(video.frames)
    assert found.camera.fx == found.camera.fy == pytest.approx(video.camera.fx, rel=0.05)
    assert (found.camera.cx, found.camera.cy) == (80, 60)
    assert abs(found.camera.distortion[0]) < 0.05
    assert found.camera.distortion[1:] == (0.0,) * 4


def test_a_lens_is_kept_where_an_adjustment_of_it_fails(
    video: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    adjust = ColmapWorkspace.adjust

    def fail(workspace: ColmapWorkspace, *limits: Any, refine_intrinsics: bool = False) -> Any:
        return pycolmap.Reconstruction() if refine_intrinsics else adjust(workspace, *limits)

    monkeypatch.setattr(ColmapWorkspace, "adjust", fail)
    found = estimate_poses(video.frames[:8], video.times[:8], (160, 120), "frames")
    assert len(found.trajectory) == 8
    assert found.camera.fx == pytest.approx(video.camera.fx, rel=0.2)


@pytest.fixture(scope="module")
def bare(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The events of the dataset and the size of its sensor, without lens, frames and poses."""
    folder = tmp_path_factory.mktemp("bare")
    (folder / "calibration.json").write_text(json.dumps({"event_camera": {"width": 160, "height": 120}}))
    shutil.copy(dataset / "events.h5", folder)
    return folder


@pytest.fixture(scope="module")
def found(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose poses and lens were found from its events."""
    folder = tmp_path_factory.mktemp("found") / "data"
    Convert(bare, output=folder, poses="events").main()
    return folder


def test_find_poses_and_lens_of_a_bare_recording(found: Path, dataset: Path, room: SimulationScene) -> None:
    report = json.loads((found / "poses_report.json").read_text())
    assert report["registered_frames"] >= report["frames"] - 1 > 9
    assert report["agreement"] > 0.8
    assert "images of the events registered" in report["summary"]
    trajectory = read_tum_trajectory(found / "trajectory_estimated.txt")
    truth = read_tum_trajectory(dataset / "trajectory_ground_truth.txt")
    errors = pose_errors(trajectory.camera_to_worlds, truth.interpolate(trajectory.times))
    # Measured: 0.5 degrees and 9 mm on a path of 1.1 m.
    assert errors["rotation_error_degrees"] < 2
    assert errors["translation_error"] < 0.03
    # It says how its poses and its lens were found.
    with CONSOLE.capture() as checked, contextlib.suppress(SystemExit):
        Check(found).main()
    told = " ".join(checked.get().split())
    assert f"How they were found: {report['summary'].splitlines()[0]}" in told
    assert "The intrinsics were estimated with the poses: focal length" in told
    lens = json.loads((found / "transforms.json").read_text())["event_camera"]
    assert lens["intrinsics_origin"] == "estimated"
    # Measured: 5 % too long on this short path.
    assert lens["fl_x"] == lens["fl_y"] == pytest.approx(room.intrinsics(160, 120)[0], rel=0.1)
    with Image.open(found / "poses_report.png") as picture:
        assert picture.size == (1456, 484)
    # The dataset can be trained on. Its world has COLMAP's scale, which training changes.
    outputs = NativeDataParserConfig(data=found).setup().get_dataparser_outputs("train")
    assert outputs.cameras.camera_to_worlds[..., 3].abs().max() == pytest.approx(1, rel=0.1)
    scene = outputs.metadata[SCENE_KEY]
    assert (scene.window.start, scene.window.end) == (trajectory.start, trajectory.end)


def test_images_that_a_mapper_lost_are_placed_again(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reconstruct = ColmapWorkspace.reconstruct

    def lose_images(workspace: ColmapWorkspace, start: object = None) -> list[Any]:
        models = reconstruct(workspace, start=start)
        if start is None:
            models.append(pycolmap.Reconstruction(models[0]))
            for image in list(models[0].images.values())[3:6]:
                models[0].deregister_frame(image.frame_id)
        return models

    monkeypatch.setattr(ColmapWorkspace, "reconstruct", lose_images)
    monkeypatch.setattr(ColmapWorkspace, "reconstruct_globally", lambda _: [])
    recording = NativeDataParserConfig(data=dataset).setup().read_recording()
    found = estimate_poses_from_events(recording, TimeWindow(end=280_000_000), dataset)
    assert found.model_sizes == [len(found.frame_times)]
    assert found.trajectory.times.tolist() == found.frame_times.tolist()
    assert recording.ground_truth is not None
    errors = pose_errors(found.trajectory.camera_to_worlds, recording.ground_truth.interpolate(found.frame_times))
    # Measured: 0.6 degrees, on half of the path.
    assert errors["rotation_error_degrees"] < 2


def test_an_interrupted_search_goes_on(
    found: Path, bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command, kept = Convert(bare, output=tmp_path / "data", poses="events"), tmp_path / ".data.colmap"

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def matches_of_first_pair(change: str = "") -> int:
        with contextlib.closing(sqlite3.connect(kept / "database.db")) as database, database:
            database.execute(change)
            return database.execute("select rows from matches order by pair_id").fetchone()[0]

    with monkeypatch.context() as patch, CONSOLE.capture() as output:
        patch.setattr(ColmapWorkspace, "reconstruct", interrupt)
        # The second command takes the matches that the first one found, also damaged ones. Another seed begins anew.
        for command.seed, is_whole in ((1, True), (1, False), (0, True)):
            if not is_whole:
                matches_of_first_pair("update matches set rows = 0, data = x''")
            with pytest.raises(KeyboardInterrupt):
                command.main()
            assert (matches_of_first_pair() > 0) == is_whole
    assert f"{kept} keeps the features and matches" in " ".join(output.get().split())
    command.main()
    assert not kept.exists()
    for name in ("trajectory_estimated.txt", "transforms.json"):
        assert (tmp_path / "data" / name).read_bytes() == (found / name).read_bytes()


@pytest.mark.parametrize(
    ("error", "left"),
    [
        (OSError(28, "No space left on device"), ["database.db", "inputs.txt"]),
        (DataError("frames", "too few", "give more"), None),
        # Once more while the database is copied, after which the next command would take the half of it.
        (KeyboardInterrupt(), ["database.db"]),
    ],
)
def test_errors_leave_what_was_kept(
    error: BaseException, left: list[str] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    for name in ("database.db", "inputs.txt"):
        (kept / name).touch()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def fail() -> None:
        with work_folder(kept):
            monkeypatch.setattr(shutil, "copyfile", interrupt)
            raise error

    with pytest.raises(type(error)):
        fail()
    assert (sorted(path.name for path in kept.iterdir()) if kept.exists() else None) == left


@pytest.mark.parametrize(("degrees", "offset", "images"), [(0.0, 15_000_000, "filter"), (2.0, 0, "network")])
def test_refine_given_poses(
    dataset: Path, tmp_path: Path, degrees: float, offset: int, images: str, request: pytest.FixtureRequest
) -> None:
    weights = request.getfixturevalue("firenet_weights") if images == "network" else None
    given = shutil.copytree(dataset, tmp_path / "given")
    truth = read_tum_trajectory(given / "trajectory_ground_truth.txt")
    noisy = perturb(truth, degrees, degrees * 0.03, 0.15, seed=2)
    late = Trajectory(noisy.times + offset, noisy.camera_to_worlds)
    write_tum_trajectory(given / "trajectory_estimated.txt", late)
    with CONSOLE.capture() as output:
        Convert(given, output=tmp_path / "scene", poses="refined", weights=weights).main()
    report = json.loads((tmp_path / "scene" / "poses_report.json").read_text())
    assert report["summary"].split(";")[0] in " ".join(output.get().split())
    before, after = (report[name]["rotation_error_degrees"] for name in ("errors_given", "errors"))
    refined = read_tum_trajectory(tmp_path / "scene" / "trajectory_estimated.txt")
    times = refined.knots_covered_by(truth)
    found = pose_errors(refined.interpolate(times), truth.interpolate(times))
    assert found["rotation_error_degrees"] == pytest.approx(after, abs=1e-4)
    assert report["correction_degrees"] > 0.5
    shared = report["shared_error"]
    assert shared["clock_offset_seconds"] * 1e9 == pytest.approx(offset, abs=3_000_000)
    assert ("ms ahead of that of the events" in report["summary"]) == (offset > 0)
    assert after < 0.1 + 0.6 * before
    with Image.open(tmp_path / "scene" / "poses_report.png") as picture:
        assert picture.size == (1456, 484)


def test_refuse_too_few_events_and_poses_beside_them(bare: Path, dataset: Path, tmp_path: Path) -> None:
    message = r"its events make . images"
    with pytest.raises(DataError, match=message):
        Convert(bare, output=tmp_path / "scene", poses="events", end_time_ns=10_000_000).main()
    given = shutil.copytree(dataset, tmp_path / "given")
    truth = read_tum_trajectory(given / "trajectory_ground_truth.txt")
    first = truth.times < truth.start + 20_000_000
    cut = Trajectory(truth.times[first], truth.camera_to_worlds[first])
    write_tum_trajectory(given / "trajectory_estimated.txt", cut)
    with pytest.raises(DataError, match=message):
        Convert(given, output=tmp_path / "scene", poses="refined").main()


def test_views_move_with_the_poses() -> None:
    times = np.arange(3) * FRAME
    given = Trajectory(times, torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    moved = given.camera_to_worlds.clone()
    moved[..., 3] += torch.tensor([0.0, 0.0, 1.0])
    moved[..., :3] = rotation_from_vector(torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    # A camera beside the event camera, and an image that was not taken on the trajectory.
    beside = torch.eye(4, dtype=torch.float64)
    beside[0, 3] = 0.2
    views = [ReferenceView(Path("a.png"), beside, FRAME), ReferenceView(Path("b.png"), beside, None)]
    on_path, elsewhere = move_views(views, given, Trajectory(times, moved))
    expected = homogeneous(moved[1]) @ beside
    torch.testing.assert_close(on_path.camera_to_world, expected)
    assert elsewhere == views[1]


def test_draw_tracks_and_paths() -> None:
    images = [np.zeros((30, 40), np.uint8)] * 6
    tracks = [(np.array([3, 8 + k]), np.array([[5.0 + k, 10], [30, 20]])) for k in range(6)]
    poses = np.tile(np.eye(4)[:3], (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    apart = poses.copy()
    apart[:, 2, 3] = 1
    picture = np.asarray(draw_poses(images, tracks, {"given": poses, "estimated": apart})).astype(int)
    # The first panel has both tracks: one moves right, the other is seen once.
    panel = picture[:240, :320]
    colored = np.ptp(panel, axis=-1) > 100
    assert colored[80, 40:72].all()
    assert colored[155:165, 235:245].sum() == 9
    # Each path in its color.
    paths = picture[:, 972:]
    for color in ((214, 39, 40), (31, 119, 180)):
        assert (np.abs(paths - color).sum(-1) == 0).sum() > 300


def test_refuse_frames_without_texture() -> None:
    frames = np.full((4, 60, 80), 128, np.uint8)
    with pytest.raises(DataError, match=r"^flat: COLMAP places none of 4 frames: they have 0 .*; .*textured"):
        estimate_poses(frames, np.arange(4) * FRAME, SMALL, "flat")


def test_refuse_unusable_frames(tmp_path: Path) -> None:
    frames = np.full((3, 60, 80), 128, np.uint8)
    for times, text in (([0, 1], "2 frames"), ([5, 5, 6], "frame 1 is not after")):
        with pytest.raises(DataError, match=text):
            estimate_poses(frames, times, SMALL, "video")
    with pytest.raises(DataError, match="video, frame 0: the frame has 60 x 80 pixels"):
        estimate_poses(frames.transpose(0, 2, 1), [0, 1, 2], SMALL, "video")
    Image.fromarray(frames[0].astype(np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(DataError, match=r"deep\.png: .*mode I;16"):
        estimate_poses([tmp_path / "deep.png"] * 3, [0, 1, 2], SMALL, "video")
    whole, cut = tmp_path / "whole.png", tmp_path / "cut.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (60, 80), np.uint8)).save(whole)
    cut.write_bytes(whole.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"cut\.png: not a PNG or JPEG image"):
        estimate_poses([whole, cut, whole], [0, 1, 2], SMALL, "video")


@pytest.mark.parametrize("pattern", ["", "RGGB"])
def test_blur_averages_linear_light(room: SimulationScene, pattern: str) -> None:
    camera = CameraIntrinsics(64, 48, *room.intrinsics(64, 48))
    simulation = Simulation(room, camera, SensorModel(bayer_pattern=pattern), "hard", 0.5, 0.5, 0)
    time, exposure, steps = 100_000_000, 0.04, 64
    frame = simulation.blurred_frame(time, exposure)
    assert frame.shape == ((48, 64, 3) if pattern else (48, 64))

    def light(picture: np.ndarray) -> np.ndarray:
        return decode(torch.from_numpy(picture / 255), "srgb").numpy()

    offsets = ((np.arange(steps) + 0.5) / steps - 0.5) * exposure * 1e9
    sharp = np.stack([simulation.blurred_frame(time + int(offset), 1e-9) for offset in offsets])
    # 8 bits of sRGB differ by up to 0.009 in light.
    error = np.abs(light(frame) - light(sharp).mean(0))
    assert error.mean() < 0.002
    assert error.max() < 0.02
    # It is a blur, and the mean of the sharp ones' sRGB would be another picture.
    assert np.abs(light(frame) - light(sharp[steps // 2])).mean() > 0.01


def test_frame_times_span_the_path(room: SimulationScene) -> None:
    camera = CameraIntrinsics(16, 12, *room.intrinsics(16, 12))
    simulation = Simulation(room, camera, SensorModel(), "easy", 0.41, 2.0, 0)
    assert simulation.frame_times(25, 0.01).tolist() == [5_000_000 + FRAME * k for k in range(11)]
    assert len(simulation.frame_times(25, 0.0101)) == 10
    for rate, exposure, text in (
        (0, 0.003, "cannot be taken"),
        (25, 0.05, "cannot be taken"),
        (2, 0.003, "fewer than"),
    ):
        with pytest.raises(ValueError, match=text):
            simulation.frame_times(rate, exposure)


@pytest.fixture
def truth() -> torch.Tensor:
    """(40, 3, 4) poses on a circle of radius 2 that turn with it."""
    angle = torch.linspace(0, 5, 40, dtype=torch.float64)
    rotations = rotation_from_vector(torch.stack([torch.zeros(40), torch.zeros(40), angle], -1).double())
    positions = 2 * torch.stack([angle.cos(), angle.sin(), 0.1 * angle], -1)
    return torch.cat([rotations, positions[..., None]], -1)


def test_find_the_metric_world(truth: torch.Tensor) -> None:
    rotation = rotation_from_vector(torch.tensor([0.4, -1.1, 2.0], dtype=torch.float64))
    shift = torch.tensor([3.0, -5, 8], dtype=torch.float64)
    elsewhere = Similarity(torch.tensor(0.037, dtype=torch.float64), rotation, shift)(truth)
    aligned, errors = compare_with_truth(Trajectory(FRAME * np.arange(40), elsewhere), truth)
    torch.testing.assert_close(aligned.camera_to_worlds, truth, rtol=0, atol=1e-10)
    assert errors.pop("extent") == pytest.approx(Trajectory(FRAME * np.arange(40), truth).extent)
    assert max(errors.values()) < 1e-8


def test_count_misplaced_and_flipped_frames(truth: torch.Tensor) -> None:
    poses = truth.clone()
    # The last third looks the other way, one frame is turned by 8 degrees, one stands a unit aside.
    for index, vector in ((slice(28, 40), [0, torch.pi * 0.9, 0]), (20, [np.radians(8), 0, 0])):
        poses[index, :, :3] = truth[index, :, :3] @ rotation_from_vector(torch.tensor(vector, dtype=torch.float64))
    poses[10, 2, 3] += 1
    elsewhere = Similarity(torch.tensor(3.0).double(), truth[7, :, :3], truth[3, :, 3])(poses)
    aligned, errors = compare_with_truth(Trajectory(FRAME * np.arange(40), elsewhere), truth)
    assert len(aligned) == 40
    assert errors["flipped_frames"] == 12
    assert errors["misplaced_frames"] == 14
    # Those that are right stay in place.
    assert errors["median_rotation_error_degrees"] < 2
    assert errors["median_translation_error"] < 0.1
    assert errors["largest_rotation_error_degrees"] == pytest.approx(162, abs=2)
    assert errors["largest_translation_error"] == pytest.approx(1, abs=0.1)
    # All frames together would be turned away from the truth.
    assert errors["rotation_error_degrees"] > 45


def test_frames_that_are_off_by_few_degrees_do_not_move_the_others(truth: torch.Tensor) -> None:
    poses = truth.clone()
    turn = rotation_from_vector(torch.tensor([0, np.radians(4), 0], dtype=torch.float64))
    poses[:8] = torch.cat([turn @ truth[:8, :, :3], turn @ truth[:8, :, 3:]], -1)
    _, errors = compare_with_truth(Trajectory(FRAME * np.arange(40), poses), truth)
    assert errors["median_rotation_error_degrees"] < 0.01
    assert errors["largest_rotation_error_degrees"] == pytest.approx(4, abs=0.01)


def test_align_all_frames_without_majority(truth: torch.Tensor) -> None:
    # A drift by which no two frames turn the world alike.
    drift = rotation_from_vector(torch.linspace(0, 2.5, 40).double()[:, None] * torch.tensor([1.0, 0, 0]).double())
    poses = torch.cat([drift @ truth[..., :3], truth[..., 3:]], -1)
    aligned, errors = compare_with_truth(Trajectory(FRAME * np.arange(40), poses), truth)
    expected = align(poses, truth)(poses)
    torch.testing.assert_close(aligned.camera_to_worlds, expected, rtol=0, atol=1e-12)
    assert errors["misplaced_frames"] > 30
