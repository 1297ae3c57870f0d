"""What a user does with a trained run, through the real commands: evaluate, resume, render, view, export."""

import csv
import errno
import json
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pycolmap
import pytest
import torch
import trimesh
import websockets.sync.client
import yaml
from helpers.browser import chromium
from helpers.commands import CPU, TIMEOUT, newest_config, run, simulate
from helpers.dataset_faults import set_in
from helpers.small_trainings import own_log
from helpers.small_viewers import free_port
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.scripts import train
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import DatasetRender, RenderCameraPath, RenderInterpolated, SpiralRender
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.cli.evaluate import Evaluate
from aenerf_ns.cli.export import ExportCameras, ExportFrames, ExportMesh, ExportTrajectory, ExportVideo
from aenerf_ns.cli.report import ReportCommand
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import read_tum_trajectory, write_tum_trajectory
from aenerf_ns.open3d_import import load_open3d

# Of the run that all tests look at.
STEPS = 300


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that all commands are started in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("workspace"))
        yield Path.cwd()


@pytest.fixture(scope="module")
def trained(workspace: Path, small_work: None) -> Path:
    """config.yml of a run on a tiny simulated room, whose events are gone since."""
    noise = ("--pose-noise-degrees", "1.5", "--pose-noise-translation", "0.04")
    data = simulate(workspace / "room", "--max-displacement", "1", *noise)
    run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", str(STEPS),
        "--steps-per-save", "200", "--data", data,
        cwd=workspace,
    )  # fmt: skip
    (data / "events.h5").rename(data / "events.gone")
    return newest_config(workspace / "outputs")


@contextmanager
def events_of(data: Path) -> Iterator[None]:
    """Put the events of a dataset back for a while."""
    (data / "events.gone").rename(data / "events.h5")
    yield
    (data / "events.h5").rename(data / "events.gone")


@pytest.fixture(scope="module")
def untrained(trained: Path) -> Path:
    """config.yml of a run of one step on the same data, trained in this process: starting takes long."""
    config = yaml.load(trained.read_text(), Loader=yaml.Loader)
    config.experiment_name, config.timestamp, config.max_num_iterations = "untrained", "{timestamp}", 1
    with own_log(), events_of(config.data):
        train.main(config)
    return newest_config(Path("outputs") / "untrained")


@pytest.fixture
def with_events(trained: Path, workspace: Path) -> Iterator[Path]:
    """The run, while its events are there again."""
    with events_of(workspace / "room"):
        yield trained


@pytest.fixture(scope="module")
def evaluated(trained: Path, workspace: Path) -> dict:
    """What ns-eval says of the run that all tests look at."""
    output, pictures = workspace / "trained.json", workspace / "pictures"
    run("ns-eval", "--load-config", trained, "--output-path", output, "--render-output-path", pictures, cwd=workspace)
    assert {path.name for path in pictures.glob("eval_img_*.png")} == {f"eval_img_{view:05d}.png" for view in range(3)}
    return json.loads(output.read_text())


def test_training_beats_an_untrained_field_on_held_out_views(evaluated: dict, untrained: Path, workspace: Path) -> None:
    results = evaluated["results"]
    assert results["color_correction"] == "affine, fitted on 4 validation views"
    assert results["num_views"] == 3
    assert results["lpips"] is None
    assert results["lpips_absent"]
    given, corrected = (results["pose_errors"][name]["rotation_error_degrees"] for name in ("estimated", "corrected"))
    assert given > 1
    assert corrected < 0.85 * given
    assert results["test_poses"] == "Sim(3) of the corrected to the true trajectory"
    refined = results["refined_test_poses"]
    assert refined.keys() == {"psnr", "psnr_std", "ssim", "ssim_std", "lpips", "test_poses"}
    assert refined["lpips"] is None
    assert refined["test_poses"].startswith("photometric refinement, 10 Levenberg-Marquardt steps, from: Sim(3)")
    assert -0.1 < refined["psnr"] - results["psnr"] < 3
    assert refined["psnr"] != results["psnr"]
    views = results["views"]
    assert [view["file"] for view in views] == [f"images/test/{view:05d}.png" for view in range(3)]
    for figures, name in ((results, "placed"), (refined, "refined")):
        for metric in ("psnr", "ssim"):
            mean = np.mean([view[name][metric] for view in views])
            assert figures[metric] == pytest.approx(mean, rel=1e-5)
    ComputePSNR(untrained, workspace / "untrained.json").main()
    worse = json.loads((workspace / "untrained.json").read_text())["results"]
    assert results["psnr"] > worse["psnr"] + 3
    assert results["ssim"] > worse["ssim"]


def test_a_run_is_evaluated_under_other_protocols(
    trained: Path, evaluated: dict, workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = next(trained.parent.rglob("*.ckpt"))
    before = (trained.read_bytes(), checkpoint.read_bytes())
    output, pictures = workspace / "network" / "metrics.json", workspace / "network" / "pictures"
    predictions = workspace / "network" / "nerfbaselines"
    Evaluate(trained, output, "network", pictures, predictions).main()
    said = capsys.readouterr().out
    written = json.loads(output.read_text())
    # The layout of ns-eval, and what it was computed with.
    assert written.pop("protocol") == {"color_correction": "network", "color_correction_of_run": "affine"}
    results, of_run = written.pop("results"), evaluated["results"]
    assert written == {key: value for key, value in evaluated.items() if key != "results"}
    assert results.keys() == of_run.keys()
    assert results["color_correction"] == "network, fitted on 4 validation views"
    for name, figures in (("placed", results), ("refined", results["refined_test_poses"])):
        assert re.search(rf"PSNR {figures['psnr']:.2f} dB,\s+SSIM\s+{figures['ssim']:.3f}", said), name
    # The same pictures in other colors.
    assert 0 < abs(results["psnr"] - of_run["psnr"]) < 3
    assert len(list(pictures.glob("eval_img_*.png"))) == 3
    assert (trained.read_bytes(), checkpoint.read_bytes()) == before
    # nerfbaselines measures the written pictures. It finds our metrics, except for the rounding to 8 bits. That lowers
    # the PSNR of so few pixels at 32 dB by 0.01 dB, +/- 0.01 dB, and by at most 0.05 dB in 2000 random pictures.
    for index, view in enumerate(results["views"]):
        rendering, truth = (
            np.asarray(Image.open(predictions / "predictions" / kind / f"{index:05d}.png")) / 255
            for kind in ("color", "gt-color")
        )
        psnr = -10 * np.log10(np.square(rendering - truth).mean())
        assert psnr == pytest.approx(view["placed"]["psnr"], abs=0.05)
    metrics = json.loads((predictions / "results.json").read_text())["metrics"]
    assert metrics == {name: pytest.approx(results[name], abs=1e-5) for name in ("psnr", "ssim")}


def test_exported_poses_are_in_the_world_of_the_recording(trained: Path, workspace: Path) -> None:
    given, truth = (
        read_tum_trajectory(workspace / "room" / f"trajectory_{n}.txt") for n in ("estimated", "ground_truth")
    )
    parser = yaml.load(trained.read_text(), Loader=yaml.Loader).pipeline.datamanager.dataparser
    # The window begins with the first event, between the first two poses.
    assert 0 < parser.start_time_ns < given.times[1]
    regular = torch.arange(parser.start_time_ns, parser.end_time_ns + 1, 10_000_000)
    # True poses of a part of the window.
    cut = shutil.copytree(workspace / "room", workspace / "cut" / "room")
    part = truth.crop(10**9, 3 * 10**9)
    write_tum_trajectory(cut / "trajectory_ground_truth.txt", part)
    for poses, rate, times, expected, data in (
        ("estimated", None, given.times, given, None),
        ("corrected", None, given.times, truth, None),
        ("estimated", 100.0, regular, given, None),
        ("ground-truth", 100.0, regular, truth, None),
        ("ground-truth", None, truth.times, truth, None),
        ("ground-truth", 100.0, regular[(regular >= part.start) & (regular <= part.end)], part, cut),
    ):
        output = workspace / "exported" / "poses.txt"
        ExportTrajectory(trained, output, poses, rate, data=data).main()
        exported = read_tum_trajectory(output)
        assert torch.equal(exported.times, times)
        difference = (exported.camera_to_worlds - expected.interpolate(times)).abs().max()
        # Correction leaves some error. The framework's float32 transform rounds the other poses.
        assert difference < (0.2 if poses == "corrected" else 1e-6)


def test_cameras_frames_and_a_mesh_go_on_to_other_tools(
    trained: Path, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ExportCameras(trained.parent, workspace / "cameras", num_points=500).main()
    model = pycolmap.Reconstruction(str(workspace / "cameras" / "sparse" / "0"))
    # All images but those outside the events, at the corrected poses, which are near the true ones.
    names = {image.name: image for image in model.images.values()}
    assert {name.split("/")[0] for name in names} == {"train", "val", "test"}
    assert model.num_points3D() > 400
    meta = json.loads((workspace / "room" / "transforms.json").read_text())
    given = {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    # Noise of the poses is no offset of the images on the rig.
    truth = read_tum_trajectory(workspace / "room" / "trajectory_ground_truth.txt")
    times = torch.tensor([round(frame["timestamp"] * 1e9) for frame in meta["frames"] if "timestamp" in frame])
    stored = [pose[:3, 3] for name, pose in given.items() if "/train/" in name]
    np.testing.assert_allclose(stored, truth.interpolate(times)[:, :, 3], atol=1e-3)
    for name, image in names.items():
        assert (workspace / "cameras" / "images" / name).is_symlink()
        center = image.cam_from_world().inverse().matrix()[:, 3]
        assert np.linalg.norm(center - given[f"images/{name}"][:3, 3]) < 0.3, name
    outputs = NerfstudioDataParserConfig(data=workspace / "cameras").setup().get_dataparser_outputs("test")
    assert len(outputs.image_filenames) == 3
    with pytest.raises(DataError, match="cameras: the folder exists already"):
        ExportCameras(trained, workspace / "cameras").main()

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    # A disk without links.
    with monkeypatch.context() as patch, CONSOLE.capture() as output:
        patch.setattr(Path, "symlink_to", refuse)
        ExportCameras(trained, workspace / "my cameras", num_points=1).main()
    assert f"--data '{workspace / 'my cameras'}' colmap" in output.get()
    copied = workspace / "my cameras" / "images" / next(iter(names))
    assert copied.is_file()
    assert not copied.is_symlink()

    ExportFrames(trained, workspace / "frames", times=("1.0", "2.5"), num_points=100).main()
    lines = (workspace / "frames" / "images.txt").read_text().splitlines()
    assert lines == ["1.000000000 images/000000.png", "2.500000000 images/000001.png"]
    for index in range(2):
        frame = np.array(Image.open(workspace / "frames" / "images" / f"{index:06d}.png"))
        assert frame.shape == (36, 48, 3)
        assert frame.std() > 5
        # The room is some meters large, and depth is in millimeters.
        depth = np.array(Image.open(workspace / "frames" / "depth" / f"{index:06d}.png"))
        assert 500 < np.median(depth) < 8000
    outputs = NerfstudioDataParserConfig(data=workspace / "frames").setup().get_dataparser_outputs("train")
    assert outputs.metadata["depth_filenames"]

    ExportMesh(trained, workspace / "mesh.ply", resolution=48, num_views=8).main()
    mesh = trimesh.load(workspace / "mesh.ply")
    assert len(mesh.faces) > 300
    # The room has 4.5 x 4.5 x 2.8 meters.
    assert 2 < mesh.extents.max() < 12


def test_a_video_shows_events_rendering_and_images(with_events: Path, workspace: Path) -> None:
    video = workspace / "along.mp4"
    ExportVideo(with_events, video, rate=2).main()
    frames = imageio.imread(video, plugin="pyav")
    # Five panels of 48 x 36 pixels, seven times as large, under a line of text.
    assert frames.shape[1:] == (16 + 7 * 36, 5 * (7 * 48 + 4), 3)
    assert len(frames) == 7
    panels = [frames[:, 16:, left : left + 7 * 48] for left in range(0, frames.shape[2], 7 * 48 + 4)]
    assert all(panel.std() > 5 for panel in panels)
    # The field has learned the events that it shows: both pictures are of the same events.
    recorded, rendered = (panel.astype(int)[..., 0] - panel.astype(int)[..., 2] for panel in panels[:2])
    assert np.corrcoef(recorded.ravel(), rendered.ravel())[0, 1] > 0.2


def test_a_point_cloud_is_in_the_world_of_the_recording(with_events: Path, workspace: Path) -> None:
    # The exporter imports Open3D, which needs a libusb that the system may lack.
    load_open3d()
    from nerfstudio.scripts.exporter import ExportPointCloud

    ExportPointCloud(
        with_events, workspace / "cloud", num_points=2000, normal_method="open3d", save_world_frame=True
    ).main()
    cloud = trimesh.load(workspace / "cloud" / "point_cloud.ply")
    assert len(cloud.vertices) > 1900
    # The same surfaces as those of the mesh, whose test places it.
    lowest, highest = np.percentile(cloud.vertices, (5, 95), axis=0)
    assert 2 < (highest - lowest).max() < 5
    assert np.abs((lowest + highest) / 2 - [0, 0, 1.2]).max() < 0.6


def test_a_report_explains_a_run(with_events: Path, workspace: Path) -> None:
    ReportCommand((with_events.parent,), workspace / "report").main()
    assert {file.name for file in (workspace / "report").iterdir()} == {"report.html", "report.json", "views.csv"}
    page = (workspace / "report" / "report.html").read_text()
    assert len(page.encode()) < 10e6
    (figures,) = json.loads((workspace / "report" / "report.json").read_text())["runs"]
    assert figures["record"]["state"] == "finished"
    assert figures["record"]["steps"] == STEPS
    assert figures["pairs"]["correlation"] > 0.3
    evo = figures["poses"]["evo"]
    assert evo["corrected"]["ate"]["rmse"] < evo["estimated"]["ate"]["rmse"] < 0.05
    with (workspace / "report" / "views.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == [f"images/test/{view:05d}.png" for view in range(3)]
    for row, view in zip(rows, figures["evaluation"]["views"], strict=True):
        assert float(row["psnr_placed"]) == view["placed"]["psnr"]
        assert f">{view['placed']['psnr']:.2f}<" in page
        assert row["lpips_placed"] == ""
    assert "LPIPS: not asked for" in page
    with chromium(workspace) as browser:
        browser.open_file(workspace / "report" / "report.html")
        browser.wait_for("[...document.querySelectorAll('.plotly-graph-div')].every((plot) => plot._fullLayout)")
        assert browser.evaluate("document.querySelectorAll('.plotly-graph-div').length") >= 8
        # No plot reaches over its neighbor.
        wide = "[...document.querySelectorAll('.plotly-graph-div')].filter((one) => one.scrollWidth > one.clientWidth)"
        assert browser.evaluate(f"{wide}.length") == 0
        assert browser.evaluate("[...document.images].every((image) => image.naturalWidth > 0)")
        # Truth, rendering, error and depth of three views, and the check's picture.
        assert browser.evaluate("document.images.length") == 13
        order = (
            "[...document.querySelectorAll('table.sortable tbody tr')]"
            ".map((row) => parseFloat(row.cells[1].dataset.value))"
        )
        head = "document.querySelectorAll('table.sortable th')[1]"
        psnr = [float(row["psnr_placed"]) for row in rows]
        assert browser.evaluate(order) == psnr
        for expected, said in ((sorted(psnr), "ascending"), (sorted(psnr, reverse=True), "descending")):
            browser.evaluate(f"{head}.click()")
            assert browser.evaluate(order) == expected
            assert browser.evaluate(f"{head}.getAttribute('aria-sort')") == said
        assert browser.complaints == []


@pytest.fixture(scope="module")
def with_other_views(untrained: Path, workspace: Path) -> Path:
    """config.yml of a copy of the untrained run on a copy of its data with another split of the views."""
    data = workspace / "other"
    shutil.copytree(workspace / "room", data)
    # The first test view is another one, so that all others have another index.
    views = [f"images/{view}.png" for view in ("val/00000", "test/00000", "test/00001")]
    set_in("transforms.json", "test_filenames", value=views)(data)
    shutil.copytree(untrained.parent, workspace / "outputs" / "other" / "aenerf-small" / "now")
    config = yaml.load(untrained.read_text(), Loader=yaml.Loader)
    config.experiment_name, config.timestamp = "other", "now"
    config.data = config.pipeline.datamanager.dataparser.data = config.pipeline.datamanager.data = data
    path = config.get_base_dir() / "config.yml"
    path.write_text(yaml.dump(config))
    return path


def test_runs_with_other_test_views_are_not_compared_in_silence(
    trained: Path, with_other_views: Path, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = r"test views: 3 \(room\) and 3 \(other\); both runs have 2 images of the same .* --allow-different"
    with monkeypatch.context() as patch:
        # It is refused before anything is measured.
        patch.setattr("aenerf_ns.report.measuring.evaluate", None)
        with pytest.raises(DataError, match=message):
            ReportCommand((trained, with_other_views), workspace / "mixed").main()
    ReportCommand((trained, with_other_views), workspace / "mixed", allow_different_protocols=True).main()
    figures = json.loads((workspace / "mixed" / "report.json").read_text())
    assert figures["views_not_in_all_runs"] == {"room": ["images/test/00002.png"], "other": ["images/val/00000.png"]}
    row = next(row for row in figures["paired_differences"] if row["metric"] == "psnr")
    assert (row["run"], row["minus"], row["num_views"]) == ("other", "room", 2)
    # It is untrained.
    assert row["mean"] < 0
    page = (workspace / "mixed" / "report.html").read_text()
    assert "These runs were measured differently" in page
    assert "2 test views are in all runs" in page
    assert "Left out: 1 of room, 1 of other." in page
    # Their events are gone, which the page says.
    assert "the events are no longer at" in page
    # The same truth beside each rendering of a view.
    pictures = re.findall(r'<img alt="" src="([^"]*)"><figcaption>truth</figcaption>', page)
    assert len(pictures) == 4
    assert [pictures[0], pictures[2]] == [pictures[1], pictures[3]]


@pytest.mark.parametrize(
    "render", [partial(RenderInterpolated, interpolation_steps=2), partial(SpiralRender, seconds=0.2)]
)
def test_rendering_a_video(render: Any, trained: Path, tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    render(trained, video).main()
    frames = imageio.imread(video, plugin="pyav")
    assert len(frames) >= 3
    assert frames.shape[1:] == (36, 48, 3)
    assert frames.std() > 5


def test_rendering_a_camera_path_of_the_viewer(trained: Path, workspace: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0.0, 0.1)
    # The part of what the viewer's render tab writes that is read.
    camera = {"camera_to_world": pose.flatten().tolist(), "fov": 75.0, "aspect": 4 / 3, "render_time": 0.0}
    path = {"camera_type": "perspective", "render_height": 36, "render_width": 48, "fps": 2, "seconds": 1.0}
    path["camera_path"] = [camera] * 2
    (workspace / "path.json").write_text(json.dumps(path))
    RenderCameraPath(
        trained, workspace / "path", camera_path_filename=workspace / "path.json", output_format="images"
    ).main()
    frames = [imageio.imread(file) for file in sorted((workspace / "path").glob("*.jpg"))]
    assert [frame.shape for frame in frames] == [(36, 48, 3)] * 2


def test_rendering_the_dataset(trained: Path, workspace: Path) -> None:
    names = ["rgb", "gt-rgb", "depth", "accumulation", "raw-log_radiance"]
    DatasetRender(trained, workspace / "dataset", split="test", rendered_output_names=names).main()
    assert {path.relative_to("dataset/test").parts[0] for path in Path("dataset").rglob("*.*")} == set(names)
    assert len(list((workspace / "dataset").rglob("*.jpg"))) == 3 * 4


def test_the_viewer_shows_a_trained_run(trained: Path, workspace: Path) -> None:
    port = free_port()
    with (workspace / "viewer.log").open("w") as log:
        viewer = subprocess.Popen(
            [Path(sys.executable).parent / "ns-viewer", "--load-config", trained, "--viewer.websocket-port", str(port)],
            cwd=workspace,
            env={**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
            stdout=log,
            stderr=log,
        )
        try:
            page = wait_for_page(port, viewer, workspace / "viewer.log")
            assert b"<!doctype html>" in page.lower()
            # The frusta are drawn last: a browser that connects is sent them.
            received = b""
            with websockets.sync.client.connect(f"ws://127.0.0.1:{port}", max_size=None) as browser:
                while b"CameraFrustumMessage" not in received:
                    received += browser.recv(timeout=60, decode=False)
        finally:
            viewer.terminate()
            viewer.wait(timeout=30)


def wait_for_page(port: int, viewer: subprocess.Popen, log: Path) -> bytes:
    deadline = time.monotonic() + TIMEOUT
    while True:
        assert viewer.poll() is None, log.read_text()[-3000:]
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as answer:
                return answer.read()
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.5)
