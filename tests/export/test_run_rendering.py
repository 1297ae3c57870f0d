"""Where exported cameras are, when they are, and what mesh the depths make."""

from dataclasses import replace
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from helpers.dataset_faults import set_in
from helpers.small_pipelines import make_pipeline, make_pipeline_config
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.errors import DataError
from aenerf_ns.evaluation.run import TrainedRun
from aenerf_ns.export import frames, mesh, video
from aenerf_ns.export.camera_model_files import PlacedImage
from aenerf_ns.export.rendering import corrected_poses, observe_points, place_views
from aenerf_ns.export.times import spread_times, times_at_rate, times_from_seconds

SECOND = 10**9


@pytest.fixture
def run(tmp_path: Path) -> TrainedRun:
    """A run whose correction is far from none. Its first test view was taken on the trajectory."""
    make_pipeline_config(tmp_path / "made")
    # After the two validation views.
    set_in("transforms.json", "frames", 2, "timestamp", value=0.25)(tmp_path / "made")
    made = make_pipeline(tmp_path / "made", "test", pose_correction="spline")
    torch.nn.init.normal_(made.model.camera_optimizer.twists.control_twists, std=0.05)
    return made.eval().trained_run()


def test_place_images_at_corrected_poses(run: TrainedRun) -> None:
    placed = place_views(run)
    assert [(image.name, image.split) for image, _ in placed] == [
        ("val/00000.png", "val"), ("val/00001.png", "val"),
        ("test/00000.png", "test"), ("test/00001.png", "test"), ("test/00002.png", "test"),
    ]  # fmt: skip
    assert all(file.is_file() for _, file in placed)
    recording = run.recording
    timed, untimed = placed[2][0].camera_to_world, placed[3][0].camera_to_world
    given = recording.reference_views["test"]
    corrected = corrected_poses(run, torch.tensor([SECOND // 4]))[0]
    rig = homogeneous(recording.trajectory.interpolate(SECOND // 4))
    on_rig = np.linalg.inv(rig) @ given[0].camera_to_world.numpy()
    np.testing.assert_allclose(timed, corrected.numpy() @ on_rig, atol=1e-9)
    # As the evaluation places it: renderings from there are compared with the image.
    cameras = run.read_reference_views("test").cameras
    in_scene = run.model.camera_optimizer.apply_to_camera(cameras)
    expected = run.scene.to_recording(in_scene.double())
    np.testing.assert_allclose(untimed[:3], expected[1], atol=1e-5)
    np.testing.assert_allclose(timed[:3], expected[0], atol=1e-5)
    # And back.
    np.testing.assert_allclose(run.scene.to_scene(torch.from_numpy(timed)[None])[0], in_scene[0], atol=1e-5)


def test_points_lie_on_their_rays(run: TrainedRun) -> None:
    run.model.field.average_init_density = 1e3
    images = [image for image, _ in place_views(run)]
    points = observe_points(run, images, 40)
    assert 20 < len(points.positions) <= 40
    for position, index, (column, row) in zip(points.positions, points.images, points.pixels, strict=True):
        image: PlacedImage = images[index]
        x, y, z = (np.linalg.inv(image.camera_to_world) @ [*position, 1.0])[:3]
        lens = image.camera
        assert z > 0
        assert (lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy) == pytest.approx((column, row), abs=1e-3)


def test_fewer_points_than_images_are_spread_over_them(run: TrainedRun) -> None:
    run.model.field.average_init_density = 1e3
    images = [image for image, _ in place_views(run)] * 20
    points = observe_points(run, images, 10)
    assert 5 <= len(points.images) <= 10
    assert points.images.max() > 80


def test_a_video_shows_an_image_from_when_it_was_taken(run: TrainedRun) -> None:
    # The image is the last of five panels, below a line of text. It was taken at 0.25 s.
    pictures = video.render_panels(run, torch.tensor([0, 2, 3]) * SECOND // 10)
    before, after = (picture[16:, 4 * picture.shape[1] // 5 : -4] for picture in pictures)
    assert (before == 0).all()
    assert (after > 0).any()


def test_a_video_triggers_events_by_learned_thresholds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_pipeline_config(tmp_path / "made")
    set_in("transforms.json", "event_camera", "positive_contrast_threshold", value=0.5)(tmp_path / "made")
    config.model.supervision.learn_contrast_threshold_ratio = True
    made = config.setup(device="cpu", test_mode="test").eval()
    made.model.supervision.raw_ratio.data.fill_(20.0)
    trigger = Mock(wraps=video.RenderedEvents)
    monkeypatch.setattr(video, "RenderedEvents", trigger)
    next(video.render_panels(made.trained_run(), torch.tensor([0, SECOND])))
    sensor = trigger.call_args.args[0]
    assert sensor.positive_contrast_threshold == pytest.approx(20 * sensor.negative_contrast_threshold)


def test_depths_too_far_to_be_written_are_counted(
    run: TrainedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.model.field.average_init_density = 1e3
    rendered = frames.render
    # As of poses in millimeters.
    monkeypatch.setattr(frames, "render", lambda *view: {**(out := rendered(*view)), "depth": 1e3 + 0 * out["depth"]})
    assert frames.export_frames(run, tmp_path / "frames", torch.tensor([SECOND // 4]), 10) == 1.0


def test_pixels_without_a_direction_have_no_depth_and_no_points(run: TrainedRun, tmp_path: Path) -> None:
    run.model.field.average_init_density = 1e3
    # The lens folds over halfway to the corners.
    lens = CameraIntrinsics(40, 30, 20.0, 20.0, 20.0, 15.0, "radial_tangential", (-0.4, 0.0, 0.0, 0.0, 0.0))
    _, usable = lens.pixel_directions()
    frames.export_frames(
        replace(run, recording=replace(run.recording, event_camera=lens)), tmp_path, torch.tensor([0]), 1
    )
    depth = np.asarray(Image.open(tmp_path / "depth" / "000000.png"))
    assert (depth[usable] > 0).any()
    assert (depth[~usable] == 0).all()
    column, row = observe_points(run, [PlacedImage("0.png", lens, np.eye(4))], 200).pixels.astype(int).T
    assert len(row) > 20
    assert usable[row, column].all()


def test_refuse_a_recording_without_images(tmp_path: Path) -> None:
    run = make_pipeline(tmp_path / "made", "test", num_views=-1, true_world=lambda poses: poses).trained_run()
    with pytest.raises(DataError, match="it has no images; aenerf export-frames renders"):
        place_views(run)


def test_times_leave_gaps_out() -> None:
    window = TimeWindow(0, SECOND, ((SECOND // 10, SECOND // 2),))
    times = spread_times(window, 60)
    assert window.contains(times).all()
    # In equal steps, but for the gap: a sixth of the time is before it.
    assert int((times <= SECOND // 10).sum()) == 10
    assert (np.diff(times)[np.diff(times) < SECOND // 10] - SECOND // 100 <= 1).all()
    assert times_at_rate(window, 20).tolist() == [0, 5 * 10**7, 10**8, *range(SECOND // 2, SECOND + 1, 5 * 10**7)]
    assert times_from_seconds(window, ["0.05", "75e-2"]).tolist() == [5 * 10**7, 75 * 10**7]
    for seconds in ("0.2", "1.5"):
        with pytest.raises(DataError, match=r"is not in the run's time, 0\.0+ to 1\.0+ s"):
            times_from_seconds(window, [seconds])
    with pytest.raises(DataError, match="--times: nan is not a time in seconds"):
        times_from_seconds(window, ["nan"])
    # float64 holds neither end.
    unix = TimeWindow(1_700_000_000 * SECOND + 1, 1_700_000_001 * SECOND - 1)
    ends = ["1700000000.000000001", "1700000000.999999999"]
    assert times_from_seconds(unix, ends).tolist() == [unix.start, unix.end]
    with pytest.raises(DataError, match=r"0\.1 gives no time at which poses are known; give a higher one"):
        times_at_rate(TimeWindow(1, SECOND, ((0, SECOND // 2),)), 0.1)
    with pytest.raises(DataError, match="1e\\+09 gives 1e\\+09 times"):
        times_at_rate(window, 1e9)
    # Less than one time in the run.
    assert times_at_rate(window, 1e-6).tolist() == [0]


def test_mesh_is_in_recording_units(run: TrainedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    # What a camera sees of a ball before it: the distance along the ray to its near side.
    center, radius = np.array([0.0, 0.1, 1.5]), 0.4

    def render(_: object, lens: CameraIntrinsics, pose: torch.Tensor) -> dict[str, torch.Tensor]:
        directions = lens.pixel_directions()[0] * [1, -1, -1] @ pose[:3, :3].numpy().T
        to_center = center - pose[:3, 3].numpy()
        along = directions @ to_center
        half_chord = radius**2 - (to_center @ to_center - along**2)
        depth = np.where(half_chord > 0, along - np.sqrt(half_chord.clip(0)), 0.0)
        # In one view Open3D sees nothing: it looks at every fourth pixel.
        if next(views) == 0:
            depth[::4, ::4] = 0
        color = np.broadcast_to([1.0, 0.5, 0.0], directions.shape)
        return {"rgb": torch.from_numpy(color.copy()).float(), "depth": torch.from_numpy(depth[..., None])}

    views = count()
    monkeypatch.setattr(mesh, "render", render)
    lens = CameraIntrinsics(96, 72, 80.0, 80.0, 48.0, 36.0)
    run = replace(run, recording=replace(run.recording, event_camera=lens))
    made = mesh.extract_mesh(run, num_views=5, resolution=48)
    distance = np.linalg.norm(made.vertices - center, axis=1)
    assert len(made.faces) > 500
    # To a voxel and a pixel: the visible cap is less than a meter wide.
    assert np.abs(distance - radius).mean() < 0.01
    assert np.quantile(np.abs(distance - radius), 0.95) < 0.03
    assert (made.visual.vertex_colors[distance < radius + 0.01] == [255, 128, 0, 255]).mean() > 0.9
    linear = mesh.extract_mesh(run, num_views=5, resolution=48, encoding="linear")
    is_near = np.linalg.norm(linear.vertices - center, axis=1) < radius + 0.01
    assert (linear.visual.vertex_colors[is_near] == [255, 55, 0, 255]).mean() > 0.9
    with pytest.raises(DataError, match=r"no two of 1 views see the same surface in voxels .*; give a higher --num"):
        mesh.extract_mesh(run, num_views=1, resolution=48)
    # The coordinates of a map.
    far, poses = torch.tensor([5e5, 5e6, 0.0]), mesh.corrected_poses
    monkeypatch.setattr(
        mesh, "corrected_poses", lambda *given: poses(*given) + torch.nn.functional.pad(far[:, None], (3, 0, 0, 1))
    )
    center = center + far.numpy()
    with pytest.raises(
        DataError, match=r"its scene lies 5e\+06 units from the origin of its world, too far for a mesh"
    ):
        mesh.extract_mesh(run, num_views=5, resolution=48)
