"""What the viewer is sent: through Nerfstudio's own viewer, without a browser's drawing."""

import io
import re
import time
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.browser import eventually
from helpers.small_pipelines import make_pipeline, make_pipeline_config
from helpers.small_viewers import DURATION, SIZE, Browser, browser_of, make_recording, sent, viewer_of
from nerfstudio.viewer.viewer import Viewer
from PIL import Image

from aenerf_ns.evaluation.poses import compare_with_ground_truth
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from aenerf_ns.training.pipeline import AENeRFPipeline

SCALE = 10


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("viewer")


@pytest.fixture(scope="module")
def pipeline(workspace: Path) -> AENeRFPipeline:
    return make_pipeline(make_recording(workspace / "data"), "val", pose_correction="spline")


@pytest.fixture(scope="module")
def viewer(pipeline: AENeRFPipeline, workspace: Path) -> Iterator[Viewer]:
    with viewer_of(pipeline, workspace) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def browser(viewer: Viewer) -> Iterator[Browser]:
    with browser_of(viewer) as browser:
        yield browser


def test_panel_adds_nothing_to_checkpoints(viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    assert viewer.viewer_elements
    assert not any("recording" in name for name in pipeline.state_dict())


def test_browser_first_looks_from_a_corrected_pose(browser: Browser, pipeline: AENeRFPipeline) -> None:
    seconds = pipeline.recording.at_time.value
    pose = pipeline.model.camera_optimizer.pose(torch.tensor([seconds], dtype=torch.float64))[0].detach().numpy()
    *before, placed = browser.until("SetCameraPositionMessage")
    position = placed["position"]
    # On a slow machine, the browser is also sent where it looks before it is moved.
    look_at = [message["look_at"] for message in before if message["type"] == "SetCameraLookAtMessage"][-1]
    np.testing.assert_allclose(position, SCALE * pose[:, 3], atol=1e-6)
    forward = np.subtract(look_at, position)
    np.testing.assert_allclose(forward / np.linalg.norm(forward), -pose[:, 2], atol=1e-3)


def test_trajectories_move_with_the_correction(viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    def lines() -> dict[str, np.ndarray]:
        found = sent(viewer, "CatmullRomSplineMessage")
        return {line.name.removeprefix("/recording/trajectory_"): np.array(line.positions) for line in found}

    correction = pipeline.model.camera_optimizer
    before = lines()
    assert before.keys() == {"estimated", "corrected", "true"}
    expected = SCALE * correction.trajectory.camera_to_worlds[:, :, 3].numpy()
    np.testing.assert_allclose(before["estimated"], expected, atol=1e-9)
    np.testing.assert_allclose(before["corrected"], expected, atol=1e-9)
    first = sent(viewer, "CatmullRomSplineMessage", "/recording/trajectory_estimated")
    with torch.no_grad():
        correction.twists.control_twists[:, 1] = 0.2 / correction.translation_unit
    with viewer.train_lock:
        pipeline.recording.draw()
    after = lines()
    moved = np.linalg.norm(after["corrected"] - before["corrected"], axis=1)
    np.testing.assert_allclose(moved, SCALE * 0.2, atol=1e-6)
    # The scene is where the corrected poses see it: the true trajectory is shown there.
    mapped = correction.alignment().inverse()(correction.compared_poses()[2])[:, :, 3]
    np.testing.assert_allclose(after["true"], SCALE * mapped.numpy(), atol=1e-9)
    # What has not moved is not sent again.
    assert sent(viewer, "CatmullRomSplineMessage", "/recording/trajectory_estimated") == first
    pipeline.recording.trajectories.value = False
    eventually(lambda: all(not m.visible for m in sent(viewer, "SetSceneNodeVisibilityMessage")[-3:]))
    pipeline.recording.trajectories.value = True


def test_picture_holds_the_events_around_the_time(viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    panel = pipeline.recording
    panel.events_number.value = 100
    panel.at_time.value = 1.5
    eventually(lambda: "100 events" in panel.events_picture.content)
    content = panel.events_picture.content
    begin, end = map(float, re.search(r"from ([-+][\d.]+) to ([-+][\d.]+) ms", content).groups())
    # 500 events a second.
    assert -200 < begin < -50
    assert 50 < end < 200
    data = re.search(r"base64,([\w+/=]+)\)", content)[1]
    picture = np.asarray(Image.open(io.BytesIO(b64decode(data))))
    assert picture.shape == (round(280 * SIZE[1] / SIZE[0]), 280, 3)
    events = pipeline.datamanager.train_dataset.timeline.nearest(1_500_000_000, 100)
    net = np.zeros(SIZE[::-1], int)
    np.add.at(net, (events.y, events.x), events.p)
    row, column = np.argwhere(net > 0)[0]
    red, green, blue = picture[int((row + 0.5) * 280 / SIZE[0]), int((column + 0.5) * 280 / SIZE[0])]
    assert red > green
    assert red > blue
    # The event camera stands at the corrected pose of the time.
    expected = SCALE * pipeline.model.camera_optimizer.pose(torch.tensor([1.5], dtype=torch.float64))[0, :, 3].detach()
    eventually(
        lambda: np.allclose(
            sent(viewer, "SetPositionMessage", "/recording/event_camera")[-1].position, expected, atol=1e-6
        )
    )


def test_events_are_points_at_the_rendered_depth(viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    panel = pipeline.recording
    panel.events_number.value = 400
    panel.at_time.value = 0.8
    panel.events_in_scene.value = True
    eventually(lambda: len(sent(viewer, "PointCloudMessage", "/recording/events")[-1].points) > 0)
    cloud = sent(viewer, "PointCloudMessage", "/recording/events")[-1]
    assert len(cloud.points) == len(cloud.colors)
    # In the event camera of each event's time, its point lies behind its pixel, 1 % nearer than what is rendered there.
    view = panel.view
    events = view.events(0.8, 400)
    with viewer.train_lock:
        points, colors = view.points(events)
    np.testing.assert_allclose(cloud.points, SCALE * points, atol=1e-5)
    assert len(points) == len(events)
    correction = pipeline.model.camera_optimizer
    with torch.no_grad():
        poses = correction.pose(torch.from_numpy(events.t * 1e-9))
    in_camera = (poses[:, :, :3].mT @ (torch.from_numpy(points).double() - poses[:, :, 3])[..., None])[..., 0].numpy()
    x = 12.0 - 20.0 * in_camera[:, 0] / in_camera[:, 2]
    y = 8.0 + 20.0 * in_camera[:, 1] / in_camera[:, 2]
    np.testing.assert_allclose(x, events.x + 0.5, atol=1e-3)
    np.testing.assert_allclose(y, events.y + 0.5, atol=1e-3)
    camera = view.camera.cameras(poses[:1])
    with viewer.train_lock:
        depth = pipeline.model.eval().get_outputs_for_camera(camera)["depth"].reshape(-1)
    distance = np.linalg.norm(in_camera[0])
    assert distance == pytest.approx(0.99 * float(depth[int(events.y[0]) * SIZE[0] + int(events.x[0])]), rel=1e-3)
    positive = colors[:, 0] > colors[:, 2]
    np.testing.assert_array_equal(positive, events.p > 0)
    panel.events_in_scene.value = False
    eventually(lambda: len(sent(viewer, "PointCloudMessage", "/recording/events")[-1].points) == 0)
    # Their number is limited for slow links.
    timeline = pipeline.datamanager.train_dataset.timeline
    with viewer.train_lock:
        points, _ = view.points(timeline[np.sort(np.random.default_rng(0).integers(len(timeline), size=9000))])
    assert len(points) <= 2000


def test_figures_of_errors_thresholds_and_colors(viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    panel = pipeline.recording
    with viewer.train_lock:
        pipeline.color_fit.fit()
        panel.draw()
    text = panel.accuracy.content
    errors = compare_with_ground_truth(pipeline.model.camera_optimizer, pipeline.datamanager.train_dataset.scene)
    given, corrected = (errors[name]["rotation_error_degrees"] for name in ("estimated", "corrected"))
    assert given > 1
    assert f"| rotation (°) | {given:.3f} | {corrected:.3f} |" in text
    assert "C⁺ 0.2, C⁻ 0.3\n" in text
    assert "affine, fitted on 2 validation views" in text


def test_figures_without_true_poses(tmp_path: Path) -> None:
    data = make_recording(tmp_path / "data", true_poses=False)
    config = make_pipeline_config(data, pose_correction="spline")
    config.model.supervision.learn_contrast_threshold_ratio = True
    pipeline = config.setup(device="cpu", test_mode="val")
    text = pipeline.recording.view.figures()
    assert "the true ones are not known. pose correction translation 0, pose correction degrees 0." in text
    assert "C⁺ 0.2, C⁻ 0.3; learned: contrast threshold ratio 0.6667" in text
    assert pipeline.recording.view.lines().keys() == {"estimated", "corrected"}
    off = make_pipeline(data, "val")
    assert "as given" in off.recording.view.figures()


def test_run_without_events_names_their_file(tmp_path: Path) -> None:
    pipeline = make_pipeline(make_recording(tmp_path / "data"), "val", pose_correction="spline")
    (tmp_path / "data" / "events.h5").unlink()
    view = pipeline.recording.view
    view.prepare()
    events = view.events(1.0, 100)
    assert view.described_picture(events, 1.0) == f"There are no events at {tmp_path / 'data' / 'events.h5'}."
    assert view.points(events)[0].shape == (0, 3)


def test_buttons_send_files_to_their_browser(
    browser: Browser, viewer: Viewer, pipeline: AENeRFPipeline, tmp_path: Path
) -> None:
    browser.click(pipeline.recording.write_trajectory)
    assert browser.wait_for("FileTransferStart")["filename"] == "trajectory_000000.txt"
    (tmp_path / "poses.txt").write_bytes(browser.wait_for("FileTransferPart")["content"])
    written = read_tum_trajectory(tmp_path / "poses.txt")
    correction = pipeline.model.camera_optimizer
    assert torch.equal(written.times, correction.trajectory.times)
    poses = correction.pose(correction.trajectory.seconds(written.times)).detach()
    expected = pipeline.datamanager.train_dataset.scene.to_recording(poses)
    torch.testing.assert_close(written.camera_to_worlds, expected, atol=1e-9, rtol=0)
    viewer.control_panel._max_res.value = 96
    browser.click(pipeline.recording.write_snapshot)
    assert browser.wait_for("FileTransferStart")["filename"] == "snapshot_rgb_000000.png"
    picture = Image.open(io.BytesIO(browser.wait_for("FileTransferPart")["content"]))
    # The browser's aspect is 1.5, the viewer's highest resolution 96.
    assert picture.size == (96, 64)
    camera = pipeline.recording.control.get_camera(64, 96)
    with viewer.train_lock:
        expected = 255 * pipeline.model.eval().get_outputs_for_camera(camera)["rgb"].numpy()
    np.testing.assert_allclose(np.asarray(picture, float), expected, atol=0.51)


def test_follow_looks_through_the_event_camera(browser: Browser, viewer: Viewer, pipeline: AENeRFPipeline) -> None:
    panel = pipeline.recording
    panel.camera_follows.value = True
    assert browser.wait_for("SetCameraFovMessage")["fov"] == pytest.approx(2 * np.arctan(8 / 20))
    eventually(lambda: not any(handle.visible for handle in viewer.camera_handles.values()))
    panel.at_time.value = 1.0
    pose = pipeline.model.camera_optimizer.pose(torch.tensor([1.0], dtype=torch.float64))[0].detach()
    eventually(
        lambda: np.allclose(browser.wait_for("SetCameraPositionMessage")["position"], SCALE * pose[:, 3], atol=1e-6)
    )
    # The time runs on by itself, and begins anew at the end.
    panel.at_time.value = DURATION
    panel.camera_plays.value = True
    eventually(lambda: panel.at_time.value == 0.0)
    eventually(lambda: panel.at_time.value > 0)
    panel.camera_plays.value = False
    panel.camera_follows.value = False
    eventually(lambda: all(handle.visible for handle in viewer.camera_handles.values()))


def test_training_draws_rarely_and_for_a_browser(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline(workspace / "data", "val", pose_correction="spline")
    panel = pipeline.recording
    # Without a viewer, nothing happens.
    panel.after_step()
    panel.draw()
    with viewer_of(pipeline, workspace) as viewer:
        drawn: list[float] = []
        monkeypatch.setattr(panel, "draw", lambda: (drawn.append(time.monotonic()), time.sleep(0.03)))
        panel.after_step()
        assert drawn == []
        with browser_of(viewer) as browser:
            browser.wait_for("SetCameraPositionMessage")
            eventually(lambda: len(drawn) == 1)
            began = time.monotonic()
            panel.after_step()
            took = time.monotonic() - began
            assert len(drawn) == 2
            # Drawing took at least 0.03 s, a hundredth of the time until it is next allowed.
            assert 0.03 * 99 <= panel.next_draw_time - began - 0.03 <= took * 100
            panel.after_step()
            assert len(drawn) == 2
