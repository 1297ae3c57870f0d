"""Alignment of trajectories and their errors, and reference views in the frame of the corrected poses."""

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.dataset_faults import set_in
from helpers.small_models import make_correction, make_model
from helpers.small_pipelines import make_pipeline, make_pipeline_config
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle

from aenerf_ns.camera.alignment import Similarity, align, align_most, pose_errors, rotation_angle
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.metadata_keys import REFERENCE_SECONDS
from aenerf_ns.camera.noise import perturb
from aenerf_ns.camera.rotation import motion_from_twist, rotation_from_vector
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.pose_refinement import refine_camera
from aenerf_ns.evaluation.poses import camera_speeds, compare_with_ground_truth
from aenerf_ns.evaluation.view_metrics import view_files
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.method.image_metrics import ImageMetrics
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig

SECOND = 10**9


def make_truth(random_poses: torch.Tensor, count: int = 120) -> Trajectory:
    times = np.linspace(0, 7 * SECOND, count).astype(np.int64)
    return Trajectory(times, Trajectory(SECOND * np.arange(8), random_poses).interpolate(times))


def some_similarity(scale: float = 0.3) -> Similarity:
    rotation = rotation_from_vector(torch.tensor([0.4, -1.2, 0.7], dtype=torch.float64))
    return Similarity(torch.tensor(scale, dtype=torch.float64), rotation, torch.tensor([1.0, -2.0, 0.5]).double())


@pytest.mark.parametrize("with_orientations", [True, False])
def test_alignment_recovers_a_similarity(with_orientations: bool, random_poses: torch.Tensor) -> None:
    reference = make_truth(random_poses).camera_to_worlds
    poses = some_similarity().inverse()(reference)
    found = align(poses, reference, with_orientations=with_orientations)
    torch.testing.assert_close(found(poses), reference, rtol=0, atol=1e-12)
    assert float(found.scale) == pytest.approx(0.3, rel=1e-12)
    errors = pose_errors(poses, reference)
    for name, value in errors.items():
        # SE(3) cannot take out a scale.
        assert (value < 1e-6) == ("se3" not in name or name == "rotation_error_degrees_se3"), name


def test_a_few_misplaced_cameras_do_not_move_the_others(random_poses: torch.Tensor) -> None:
    truth = make_truth(random_poses)
    reference = truth.camera_to_worlds
    poses = reference.clone()
    # A fifth of the path is turned and shifted as one, as where structure from motion lost the thread.
    misplaced = len(poses) // 5
    poses[:misplaced] = some_similarity(scale=1.0)(poses[:misplaced])
    rest = slice(misplaced, None)
    errors = {}
    for method in (align, align_most):
        placed = method(some_similarity().inverse()(poses), reference)(some_similarity().inverse()(poses))
        errors[method] = float((placed - reference)[rest].norm(dim=(1, 2)).max())
    assert errors[align] > 0.1
    assert errors[align_most] < 1e-3
    correction = make_correction(Trajectory(truth.times, poses), truth, mode="off")
    placed = correction.alignment()(poses)
    assert float((placed - reference)[rest].norm(dim=(1, 2)).max()) < 1e-3


def test_the_positions_of_a_camera_that_only_turns_do_not_count(random_poses: torch.Tensor) -> None:
    reference = make_truth(random_poses).camera_to_worlds
    reference[..., 3] = torch.tensor([1.3, 2.1, -0.7])
    for method in (align, align_most):
        placed = method(some_similarity().inverse()(reference), reference)(some_similarity().inverse()(reference))
        torch.testing.assert_close(placed[..., :3], reference[..., :3], rtol=0, atol=1e-9)
    misplaced = reference.clone()
    misplaced[:20] = some_similarity(scale=1.0)(misplaced[:20])
    placed = align_most(misplaced, reference)(misplaced)
    assert float(rotation_angle(placed, reference)[20:].max()) < 1e-2


def test_errors_are_those_of_known_displacements(random_poses: torch.Tensor) -> None:
    # Errors that no similarity can take out: alternating, along an axis of the camera.
    reference = make_truth(random_poses, 2000).camera_to_worlds
    sign = (-1.0) ** torch.arange(2000, dtype=torch.float64)[:, None]
    twist = sign * torch.tensor([0.01, 0, 0, 0, 0, 0.02], dtype=torch.float64)
    poses = (homogeneous(reference) @ motion_from_twist(twist))[:, :3]
    errors = pose_errors(poses, reference)
    assert errors["rotation_error_degrees"] == pytest.approx(np.degrees(0.02), rel=1e-3)
    assert errors["translation_error"] == pytest.approx(0.01, rel=1e-3)
    assert errors["ate_rmse_se3"] == pytest.approx(0.01, rel=1e-3)
    length = float(reference[..., 3].diff(dim=0).norm(dim=-1).sum())
    assert errors["translation_error_percent"] == pytest.approx(100 * errors["translation_error"] / length)


def test_orientations_settle_the_alignment_of_a_straight_line() -> None:
    # Positions on a line leave the rotation about it open.
    reference = torch.eye(4, dtype=torch.float64)[:3].repeat(50, 1, 1)
    reference[:, 0, 3] = torch.linspace(0, 1, 50)
    generator = torch.Generator().manual_seed(0)
    noise = 1e-3 * torch.randn(50, 6, generator=generator, dtype=torch.float64)
    poses = some_similarity()((homogeneous(reference) @ motion_from_twist(noise))[:, :3])
    assert pose_errors(poses, reference)["rotation_error_degrees"] < 0.2
    still = reference[:1].expand(50, 3, 4)
    errors = pose_errors(some_similarity()(still), still)
    assert errors["rotation_error_degrees"] < 1e-6
    assert all(np.isfinite(list(errors.values())))
    assert align(some_similarity()(still), still).scale == 1


def test_a_mirrored_trajectory_is_not_aligned_by_a_reflection(random_poses: torch.Tensor) -> None:
    reference = make_truth(random_poses).camera_to_worlds
    for factors in ([-1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]):
        mirrored = reference.clone()
        mirrored[..., 3] *= torch.tensor(factors)
        for with_orientations in (True, False):
            found = align(mirrored, reference, with_orientations=with_orientations)
            assert float(torch.linalg.det(found.rotation)) == pytest.approx(1.0)
            assert found.scale > 0
        assert pose_errors(mirrored, reference)["translation_error"] > 0.1


def test_small_rotation_angles_are_exact() -> None:
    identity = torch.eye(3, 4, dtype=torch.float64)[None]
    for angle in (1e-12, 1e-6, 0.5, 3.14):
        vector = torch.tensor([[0.6 * angle, -0.8 * angle, 0.0]], dtype=torch.float64)
        turned = torch.cat([rotation_from_vector(vector), torch.zeros(1, 3, 1).double()], -1)
        assert float(rotation_angle(turned, identity)) == pytest.approx(angle, rel=1e-9)


def learned_correction(trajectory: Trajectory, ground_truth: Trajectory | None) -> PoseCorrection:
    """A correction that is far from none."""
    torch.manual_seed(0)
    correction = make_correction(trajectory, ground_truth, mode="spline", knot_interval=1.0)
    torch.nn.init.normal_(correction.twists.control_twists, std=0.05)
    return correction


def reference_cameras(poses: torch.Tensor, seconds: list[float]):
    cameras = CameraIntrinsics(4, 3, 5.0, 5.0, 2.0, 1.5).cameras(poses)
    cameras.metadata[REFERENCE_SECONDS] = torch.tensor(seconds, dtype=torch.float64)[:, None]
    return cameras


def test_without_ground_truth_views_follow_the_correction_of_their_time(random_poses: torch.Tensor) -> None:
    trajectory = make_truth(random_poses)
    correction = learned_correction(trajectory, None)
    seconds = [1.3, 4.0]
    cameras = reference_cameras(trajectory.pose(torch.tensor(seconds).double()), seconds)
    expected = correction.pose(torch.tensor(seconds).double())
    torch.testing.assert_close(correction.apply_to_camera(cameras), expected.float(), rtol=0, atol=1e-6)
    # A camera that is mounted elsewhere on the rig keeps its place there.
    mount = motion_from_twist(torch.tensor([0.1, 0.2, -0.1, 0.3, 0.0, 0.1], dtype=torch.float64))
    cameras = reference_cameras((homogeneous(trajectory.pose(torch.tensor(seconds).double())) @ mount)[:, :3], seconds)
    expected = (homogeneous(expected) @ mount)[:, :3]
    torch.testing.assert_close(correction.apply_to_camera(cameras), expected.float(), rtol=0, atol=1e-6)
    # One that was not taken on the trajectory moves with the trajectory as a whole.
    cameras = reference_cameras(random_poses[:1], [np.nan])
    expected = correction.alignment().inverse()(random_poses[:1])
    torch.testing.assert_close(correction.apply_to_camera(cameras), expected.float(), rtol=0, atol=1e-6)


def test_with_ground_truth_views_are_carried_by_the_alignment_to_it(random_poses: torch.Tensor) -> None:
    truth = make_truth(random_poses)
    # The estimated trajectory is the true one in another world, and the correction is none.
    estimated = Trajectory(truth.times, some_similarity()(truth.camera_to_worlds))
    correction = learned_correction(estimated, truth)
    torch.nn.init.zeros_(correction.twists.control_twists)
    views = random_poses[2:5]
    carried = correction.apply_to_camera(reference_cameras(views, [np.nan, 0.5, 1.0]))
    torch.testing.assert_close(carried, some_similarity()(views).float(), rtol=0, atol=1e-5)
    # Other cameras, such as the viewer's, are in the scene's frame and stay.
    others = CameraIntrinsics(4, 3, 5.0, 5.0, 2.0, 1.5).cameras(views)
    assert correction.apply_to_camera(others) is others.camera_to_worlds


def test_the_true_poses_may_be_in_another_world(tmp_path: Path) -> None:
    world = some_similarity(2.5)
    plain = make_pipeline(tmp_path / "plain", "test")
    moved = make_pipeline(tmp_path / "moved", "test", true_world=lambda poses: world(poses[..., :3, :]))
    errors = compare_with_ground_truth(moved.model.camera_optimizer, moved.datamanager.train_dataset.scene)
    # With digits as the files have them.
    assert all(errors["estimated"][name] < 1e-5 for name in ("rotation_error_degrees", "translation_error"))
    assert errors["estimated"]["translation_error_se3"] > 0.05
    correction = moved.model.camera_optimizer
    views = [pipeline.datamanager.reference_views("test") for pipeline in (plain, moved)]
    expected, given = (view.cameras for view in views)
    assert (given.camera_to_worlds - expected.camera_to_worlds).abs().max() > 0.5
    torch.testing.assert_close(correction.apply_to_camera(given), expected.camera_to_worlds, rtol=0, atol=1e-5)
    truth = read_tum_trajectory(tmp_path / "moved" / "trajectory_ground_truth.txt")
    in_recording = moved.trained_run().scene.to_recording(correction.compared_poses()[2])
    torch.testing.assert_close(in_recording, truth.camera_to_worlds, rtol=0, atol=1e-6)


@pytest.mark.parametrize("num_views", [2, -1])
def test_a_trained_run_shows_and_exports_the_corrected_poses(num_views: int, tmp_path: Path) -> None:
    pipeline = make_pipeline(tmp_path / "made", "test", num_views=num_views, pose_correction="spline")
    correction, data = pipeline.model.camera_optimizer, pipeline.datamanager
    torch.nn.init.normal_(correction.twists.control_twists, std=0.05)
    estimated = data.train_dataset.cameras
    with torch.no_grad():
        expected = correction.pose(correction._camera_seconds).float()
    assert (estimated.camera_to_worlds - expected).abs().max() > 0.01
    # As ns-export cameras and ns-render dataset do.
    torch.testing.assert_close(correction.apply_to_camera(estimated), expected)
    # As the viewer does while training.
    indices = torch.arange(len(estimated))
    moved = (homogeneous(estimated.camera_to_worlds) @ homogeneous(correction(indices)))[:, :3]
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-6)
    # Opening a run moves them, once.
    pipeline.load_state_dict(pipeline.state_dict())
    opened = data.train_dataset.cameras
    torch.testing.assert_close(opened.camera_to_worlds, expected)
    torch.testing.assert_close(correction.apply_to_camera(opened), expected)
    torch.testing.assert_close(homogeneous(correction(indices)), torch.eye(4).expand(len(indices), 4, 4))
    # ns-render spiral starts there: without views at a training camera.
    start, _ = data.eval_dataloader.get_camera(0)
    assert torch.equal(start.camera_to_worlds[0], data.eval_dataset.cameras.camera_to_worlds[0])
    assert not start.metadata


def test_opening_a_run_keeps_all_that_was_learned(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "data")
    # Every second pose is off by a quarter of the path, so the spline has a finer one.
    lines = [f"{i / 20} {i / 100} {i % 2 / 20} 0 0 0 0 1" for i in range(21)]
    (tmp_path / "data" / "trajectory_estimated.txt").write_text("\n".join(lines))
    config.model.camera_optimizer = PoseCorrectionConfig(mode="spline", rigid_offset=True, clock_offset=0.0)
    trained, opened = (config.setup(device="cpu", test_mode="test") for _ in range(2))
    for parameter in trained.parameters():
        torch.nn.init.normal_(parameter)
    opened.load_state_dict(trained.state_dict())
    expected, found = (dict(pipeline.named_parameters()) for pipeline in (trained, opened))
    assert {name.rpartition("camera_optimizer.")[2] for name in expected} >= {
        "rigid_offset", "clock_change", "twists.control_twists", "twists.finer.control_twists",
    }  # fmt: skip
    assert [name for name, values in expected.items() if not torch.equal(values, found[name])] == []


def test_ns_render_shows_training_cameras_where_there_are_no_validation_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["ns-render", "dataset", "--split", "val"])
    data = make_pipeline_config(tmp_path / "made", num_views=0).datamanager.setup(device="cpu", test_mode="val")
    assert data.eval_dataset is data.train_dataset


def test_files_of_views_are_relative_to_the_folder_of_an_event_file(tmp_path: Path) -> None:
    views = SimpleNamespace(image_filenames=[tmp_path / "images" / "0.png"])
    assert view_files(SimpleNamespace(data=tmp_path / "events.raw", views=views)) == ["images/0.png"]


def test_ground_truth_must_overlap_the_estimated_poses(random_poses: torch.Tensor) -> None:
    truth = make_truth(random_poses)
    late = Trajectory(truth.times + 8 * SECOND, truth.camera_to_worlds, "truth.txt")
    with pytest.raises(DataError, match=r"^truth.txt: .*do not cover two of the estimated ones"):
        learned_correction(truth, late)
    # Where it covers a part, that part is compared.
    half = truth.crop(0, 3 * SECOND)
    estimated, corrected, reference = learned_correction(truth, half).compared_poses()
    assert len(estimated) == len(corrected) == len(reference) == len(half)
    # Between true poses that are far apart nothing is known.
    times = torch.arange(40) * (SECOND // 10)
    estimate = Trajectory(times, motion_from_twist(torch.sin(torch.outer(times / SECOND, torch.arange(1.0, 7.0)))))
    known = (times <= SECOND) | (times >= 3 * SECOND)
    gappy = Trajectory(times[known], estimate.camera_to_worlds[known])
    assert torch.equal(estimate.knots_covered_by(gappy), times[known])
    # A rate that changes is no gap.
    slower = (times <= SECOND) | (times % (SECOND // 2) == 0)
    rare = Trajectory(times[slower], estimate.camera_to_worlds[slower])
    assert torch.equal(estimate.knots_covered_by(rare), times[times <= rare.end])
    torch.testing.assert_close(estimated, reference, rtol=0, atol=1e-12)


def _known_camera() -> tuple[AENeRFModel, Cameras, torch.Tensor]:
    """A model of a scene with texture, a camera (1,) that looks at it, and the camera's pose (4, 4)."""
    model = make_model(bounded=True, average_init_density=3.0).eval()
    torch.nn.init.uniform_(model.field.encoding.hash_table, -1, 1)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 2.5])
    return model, CameraIntrinsics(32, 24, 30.0, 30.0, 16.0, 12.0).cameras(pose[None, :3]), pose


def test_photometric_refinement_finds_the_camera_back() -> None:
    model, camera, pose = _known_camera()
    before = copy.deepcopy(model.state_dict())
    image = model.get_outputs_for_camera(camera)["rgb"]
    moved = pose @ motion_from_twist(torch.tensor([0.02, -0.03, 0.0, -0.01, -0.02, -0.02], dtype=torch.float64))
    wrong = replace(camera, camera_to_worlds=moved[None, :3].float())
    # Where the camera sees points of the scene, in pixels.
    points = torch.tensor([[x, y, z, 1.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.3, 0.3)]).double()

    def pixels_off(poses: torch.Tensor) -> float:
        seen = [points @ torch.linalg.inv(one).mT for one in (homogeneous(poses.double())[0], pose)]
        places = [30 * point[:, :2] / point[:, 2:3] for point in seen]
        return float((places[0] - places[1]).norm(dim=-1).max())

    assert pixels_off(wrong.camera_to_worlds) > 0.8
    # Pixels without a direction do not count, whatever the picture shows there.
    usable = torch.arange(32).expand(24, 32) < 28
    image[~usable] = 0.7
    refined = refine_camera(model, wrong, image, usable)
    assert pixels_off(refined.camera_to_worlds) < 0.05
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert all(parameter.grad is None for parameter in model.parameters())


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_picture_that_says_nothing_leaves_the_camera_where_it_is(value: float) -> None:
    model, camera, _ = _known_camera()
    image = torch.full((24, 32, 3), value)
    # All display values clip at the picture's own.
    model.color_correction.offset.fill_(-1e3 if value == 0 else 1e3)
    refined = refine_camera(model, camera, image, torch.ones(24, 32, dtype=torch.bool))
    torch.testing.assert_close(refined.camera_to_worlds, camera.camera_to_worlds, rtol=0, atol=0)


def test_metrics_are_of_placed_and_of_refined_test_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The pictures are too small for SSIM's window.
    monkeypatch.setattr(
        ImageMetrics, "__call__", lambda _, a, b, __: {"psnr": -10 * float((a - b).square().mean().log10())}
    )
    pipeline = make_pipeline(tmp_path / "made", "test")
    placed = [camera.camera_to_worlds.clone() for camera, _ in pipeline.datamanager.fixed_indices_eval_dataloader]
    metrics = json.loads(json.dumps(pipeline.get_average_eval_image_metrics(get_std=True)))
    refined = metrics["refined_test_poses"]
    assert refined["test_poses"].endswith(f"from: {metrics['test_poses']}")
    for view in metrics["views"]:
        # Not taken on the trajectory.
        assert view["time_ns"] is view["camera_speed"] is view["camera_turn_rate_degrees"] is None
    # The pose correction of this pipeline is off.
    assert metrics["test_poses"].startswith("as the dataset gives them")
    after = [camera.camera_to_worlds for camera, _ in pipeline.datamanager.fixed_indices_eval_dataloader]
    assert torch.equal(torch.stack(after), torch.stack(placed))
    pipeline.config.refine_test_poses = False
    again = pipeline.get_average_eval_image_metrics(get_std=True)
    assert "refined_test_poses" not in again
    assert again["psnr"] == metrics["psnr"]
    # While training, never.
    training = make_pipeline(tmp_path / "made", "val").get_average_eval_image_metrics()
    assert all(isinstance(value, float) for value in training.values())


def test_views_on_the_trajectory_have_their_times_and_the_camera_s_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ImageMetrics, "__call__", lambda *_: {"psnr": 20.0})
    make_pipeline_config(tmp_path / "made", num_views=0)
    # The camera moves along x, by 0.1 units in half a second.
    set_in("transforms.json", "frames", 0, "timestamp", value=0.25)(tmp_path / "made")
    pipeline = make_pipeline(tmp_path / "made", "test")
    (view,) = pipeline.get_average_eval_image_metrics()["views"]
    assert view["time_ns"] == 250_000_000
    assert view["camera_speed"] == pytest.approx(0.2, rel=1e-5)
    assert view["camera_turn_rate_degrees"] == pytest.approx(0, abs=1e-6)
    # A radian a second about an axis, in steps that the spline follows closely.
    turning = torch.linspace(0, 1, 21, dtype=torch.float64)
    rotations = rotation_from_vector(turning[:, None] * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    poses = torch.cat([rotations, torch.zeros(21, 3, 1)], -1)
    pipeline.model.camera_optimizer.trajectory = Trajectory(SECOND // 20 * np.arange(21), poses)
    run = pipeline.trained_run()
    _, turn_rates = camera_speeds(run.model.camera_optimizer, run.scene, torch.tensor([0.5], dtype=torch.float64))
    assert float(turn_rates) == pytest.approx(math.degrees(1), rel=1e-4)


def test_speeds_are_in_the_units_of_the_true_poses(random_poses: torch.Tensor) -> None:
    truth = make_truth(random_poses)
    tenfold = truth.camera_to_worlds.clone()
    tenfold[:, :, 3] *= 10
    scene = SimpleNamespace(scale=1.0)
    middle = torch.tensor([truth.duration / 2], dtype=torch.float64)
    speeds = [
        camera_speeds(learned_correction(estimated, truth), scene, middle)[0]
        for estimated in (truth, Trajectory(truth.times, tenfold))
    ]
    torch.testing.assert_close(speeds[0], speeds[1])


@pytest.mark.parametrize("mode", [pytest.param("network", marks=pytest.mark.slow), "spline"])
def test_in_a_known_scene_the_correction_finds_the_true_poses(mode: str) -> None:
    times = np.linspace(0, SECOND, 60).astype(np.int64)
    path = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    path[:, 2, 3] = 2.2
    path[:, 0, 3] = torch.linspace(-0.5, 0.5, 60)
    truth = Trajectory(times, path)
    estimated = perturb(truth, rotation_degrees=2.0, translation=0.05, correlation_time=0.3, seed=0)
    config = PoseCorrectionConfig(mode=mode)
    model = make_model(bounded=True, camera_optimizer=config, field={"max_resolution": 16}, trajectory=estimated)
    torch.nn.init.uniform_(model.field.encoding.hash_table, -0.5, 0.5)
    model.field.average_init_density = 3.0
    reference = make_correction(truth, mode="off")
    correction = model.camera_optimizer
    generator = torch.Generator().manual_seed(0)

    def errors() -> torch.Tensor:
        # Not aligned: the scene holds the frame.
        seconds = torch.linspace(0, 1, 50, dtype=torch.float64)
        with torch.no_grad():
            poses, true = correction.pose(seconds), reference.pose(seconds)
        return torch.stack([rotation_angle(poses, true).mean(), (poses - true)[..., 3].norm(dim=-1).mean()])

    before = errors()
    optimizer = torch.optim.Adam(correction.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 150)
    for _ in range(150):
        directions = torch.randn(256, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.3, 0.3, 0.0])
        directions = torch.nn.functional.normalize(directions - torch.tensor([0.0, 0.0, 1.0]), dim=-1)
        seconds = torch.rand(256, 1, generator=generator, dtype=torch.float64)
        rendered = []
        for source in (correction, reference):
            rays = RayBundle(
                origins=torch.zeros(256, 3),
                directions=directions.float(),
                pixel_area=torch.ones(256, 1),
                times=seconds,
                metadata={"camera_directions": directions},
            )
            source.apply_to_raybundle(rays)
            rays.metadata = {}
            rendered.append(model.eval()(rays)["log_radiance"])
        optimizer.zero_grad()
        (rendered[0] - rendered[1].detach()).square().mean().backward()
        optimizer.step()
        schedule.step()
    assert (errors() < before / 3).all(), (before, errors())


def test_learned_offsets_are_reported(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "made", num_views=-1, true_world=lambda poses: poses)
    config.model.camera_optimizer = PoseCorrectionConfig(rigid_offset=True, clock_offset=0.01)
    pipeline = config.setup(device="cpu", test_mode="test")
    correction = pipeline.model.camera_optimizer
    torch.nn.init.constant_(correction.rigid_offset, 0.01)
    metrics = pipeline.get_average_eval_image_metrics()
    assert metrics["clock_offset_seconds"] == pytest.approx(0.01)
    assert metrics["rigid_offset_degrees"] == pytest.approx(math.degrees(0.01 * 3**0.5))
    assert metrics["rigid_offset_translation"] == pytest.approx(0.01 * 3**0.5 * correction.trajectory.extent)


def test_exporters_of_the_framework_choose_the_rays_of_a_batch(tmp_path: Path) -> None:
    data = make_pipeline(tmp_path / "made", "test").datamanager
    assert data.get_train_rays_per_batch() == data.config.train_num_rays_per_batch
    data.train_pixel_sampler.num_rays_per_batch = 6
    assert len(data.next_train(0)[0]) == 6
