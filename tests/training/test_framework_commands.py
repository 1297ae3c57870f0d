"""What a user does with a trained run, through the real commands: evaluate, resume, render, view, export."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import websockets.sync.client
from commands import CPU, newest_config, run, simulate

from aenerf_ns.files.tum_trajectory import read_tum_trajectory

# Steps of the run that all tests look at, and how much better than an untrained field it must be on held-out views.
STEPS = 300
PSNR_MARGIN = 3.0


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("workspace")


@pytest.fixture(scope="module")
def trained(workspace: Path) -> Path:
    """config.yml of a run on a tiny simulated room, whose events are gone since."""
    data = simulate(workspace / "room")
    run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", str(STEPS),
        "--steps-per-save", "200", "--data", data,
        cwd=workspace,
    )  # fmt: skip
    (data / "events.h5").rename(data / "events.gone")
    return newest_config(workspace / "outputs")


def evaluate(config: Path, workspace: Path, name: str) -> dict:
    output = workspace / f"{name}.json"
    pictures = workspace / f"{name}_pictures"
    run("ns-eval", "--load-config", config, "--output-path", output, "--render-output-path", pictures, cwd=workspace)
    assert {path.name for path in pictures.glob("eval_img_*.png")} == {f"eval_img_{view:05d}.png" for view in range(3)}
    return json.loads(output.read_text())


@pytest.fixture(scope="module")
def evaluated(trained: Path, workspace: Path) -> dict:
    """What ns-eval says of the run that all tests look at."""
    return evaluate(trained, workspace, "trained")


def test_training_beats_an_untrained_field_on_held_out_views(evaluated: dict, workspace: Path) -> None:
    results = evaluated["results"]
    assert results["color_correction"] == "affine, fitted on 4 validation views"
    assert results["num_views"] == 3
    assert results["lpips"] is None
    assert results["lpips_absent"]
    # The given poses are the true ones.
    assert results["pose_errors"]["estimated"]["rotation_error_degrees"] < 1e-5
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
    data = workspace / "room"
    (data / "events.gone").rename(data / "events.h5")
    run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", "1", "--data", data,
        "--experiment-name", "untrained", cwd=workspace,
    )  # fmt: skip
    (data / "events.h5").rename(data / "events.gone")
    untrained = evaluate(newest_config(workspace / "outputs" / "untrained"), workspace, "untrained")["results"]
    assert results["psnr"] > untrained["psnr"] + PSNR_MARGIN
    assert results["ssim"] > untrained["ssim"]


def test_a_run_is_evaluated_under_other_protocols(trained: Path, evaluated: dict, workspace: Path) -> None:
    checkpoint = next(trained.parent.rglob("*.ckpt"))
    before = (trained.read_bytes(), checkpoint.read_bytes())
    output, pictures = workspace / "network" / "metrics.json", workspace / "network" / "pictures"
    options = ("--color-correction", "network", "--render-output", pictures)
    said = run("aenerf", "evaluate", "--load-config", trained, "--output", output, *options, cwd=workspace)
    written = json.loads(output.read_text())
    # The layout of ns-eval, and what it was computed with.
    assert written.pop("protocol") == {"color_correction": "network", "color_correction_of_run": "affine"}
    results, of_run = written.pop("results"), evaluated["results"]
    assert written == {key: value for key, value in evaluated.items() if key != "results"}
    assert results.keys() == of_run.keys()
    assert results["color_correction"] == "network, fitted on 4 validation views"
    for name, figures in (("placed", results), ("refined", results["refined_test_poses"])):
        assert re.search(rf"PSNR {figures['psnr']:.2f} dB,\s+SSIM\s+{figures['ssim']:.3f}", said), name
    # The same pictures in other colours.
    assert 0 < abs(results["psnr"] - of_run["psnr"]) < 3
    assert len(list(pictures.glob("eval_img_*.png"))) == 3
    assert (trained.read_bytes(), checkpoint.read_bytes()) == before
    missing = ("aenerf", "evaluate", "--load-config", "nothing.yml", "--output", output)
    assert "nothing.yml: there is no such file" in run(*missing, cwd=workspace, fails=True)


def test_resuming_continues_from_the_checkpoint(trained: Path, workspace: Path) -> None:
    data = workspace / "room"
    (data / "events.gone").rename(data / "events.h5")
    run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", "5", "--data", data,
        "--experiment-name", "resumed", "--load-dir", trained.parent / "nerfstudio_models", cwd=workspace,
    )  # fmt: skip
    (data / "events.h5").rename(data / "events.gone")
    (checkpoint,) = (workspace / "outputs" / "resumed").rglob("*.ckpt")
    assert checkpoint.name == f"step-{STEPS + 4:09d}.ckpt"
    before = torch.load(next(trained.parent.rglob("*.ckpt")), weights_only=True)
    after = torch.load(checkpoint, weights_only=True)
    key = "_model.field.density_network.layers.0.weight"
    change = (after["pipeline"][key] - before["pipeline"][key]).abs()
    # A few steps on from there, at the learning rate of the end of the run: not a new start.
    assert 0 < change.max() < 0.05
    assert after["schedulers"]["networks"]["last_epoch"] == STEPS + 5
    assert after["optimizers"]["networks"]["state"][0]["step"] == STEPS + 5


def test_exported_poses_are_in_the_world_of_the_recording(trained: Path, workspace: Path) -> None:
    given = read_tum_trajectory(workspace / "room" / "trajectory_estimated.txt")
    for poses, rate, times in (
        ("estimated", (), given.times),
        ("corrected", (), given.times),
        ("ground-truth", ("--rate", "100"), torch.arange(0, given.end + 1, 10_000_000)),
    ):
        output = workspace / "exported" / "poses.txt"
        options = ("--poses", poses, *rate)
        run("aenerf", "export-trajectory", "--load-config", trained, "--output", output, *options, cwd=workspace)
        exported = read_tum_trajectory(output)
        assert torch.equal(exported.times, times)
        difference = (exported.camera_to_worlds - given.interpolate(times)).abs().max()
        if poses == "corrected":
            # Corrected for some steps, of poses that are the true ones.
            assert 1e-4 < difference < 0.2
        else:
            # The given ones, but for the framework's float32 transform.
            assert difference < 1e-6
    missing = ("aenerf", "export-trajectory", "--load-config", "nothing.yml", "--output", output)
    assert "nothing.yml: there is no such file" in run(*missing, cwd=workspace, fails=True)


@pytest.mark.parametrize(
    "mode",
    [
        ("interpolate", "--interpolation-steps", "2"),
        ("spiral", "--seconds", "0.2"),
    ],
    ids=lambda mode: mode[0],
)
def test_rendering_a_video(mode: tuple[str, ...], trained: Path, workspace: Path) -> None:
    video = workspace / f"{mode[0]}.mp4"
    run("ns-render", *mode, "--load-config", trained, "--output-path", video, cwd=workspace)
    frames = imageio.imread(video, plugin="pyav")
    assert len(frames) >= 3
    assert frames.shape[1:] == (36, 48, 3)
    assert frames.std() > 5


def test_rendering_a_camera_path_of_the_viewer(trained: Path, workspace: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0.0, 0.1)
    # What the viewer's render tab writes.
    path = {
        "default_fov": 75.0,
        "default_transition_sec": 2.0,
        "keyframes": [],
        "camera_type": "perspective",
        "render_height": 36,
        "render_width": 48,
        "fps": 2,
        "seconds": 1.0,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": [{"camera_to_world": pose.flatten().tolist(), "fov": 75.0, "aspect": 4 / 3, "render_time": 0.0}]
        * 2,
    }
    (workspace / "path.json").write_text(json.dumps(path))
    run(
        "ns-render", "camera-path", "--load-config", trained, "--camera-path-filename", workspace / "path.json",
        "--output-path", workspace / "path", "--output-format", "images", cwd=workspace,
    )  # fmt: skip
    frames = [imageio.imread(file) for file in sorted((workspace / "path").glob("*.jpg"))]
    assert [frame.shape for frame in frames] == [(36, 48, 3)] * 2


def test_rendering_the_dataset(trained: Path, workspace: Path) -> None:
    run(
        "ns-render", "dataset", "--load-config", trained, "--output-path", workspace / "dataset", "--split", "test",
        "--rendered-output-names", "rgb", "gt-rgb", "depth", "accumulation", "raw-log_radiance", cwd=workspace,
    )  # fmt: skip
    names = {path.relative_to(workspace / "dataset" / "test").parts[0] for path in (workspace / "dataset").rglob("*.*")}
    assert names == {"rgb", "gt-rgb", "depth", "accumulation", "raw-log_radiance"}
    assert len(list((workspace / "dataset").rglob("*.jpg"))) == 3 * 4


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


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
    deadline = time.monotonic() + 120
    while True:
        assert viewer.poll() is None, log.read_text()[-3000:]
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as answer:
                return answer.read()
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.5)
