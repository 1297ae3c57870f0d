"""The path a user goes, through the real commands: simulate, train, resume, evaluate, render, view."""

from __future__ import annotations

import json
import os
import re
import shutil
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

from aenerf_ns.dataparsers.tum_trajectory import read_tum_trajectory

# Steps of the run that all tests look at, and how much better than an untrained field it must be on held-out views.
STEPS = 300
PSNR_MARGIN = 3.0
CPU = ("--machine.device-type", "cpu")


def run(*command: str | Path, cwd: Path, fails: bool = False) -> str:
    """Runs a console script of this environment and returns its output, without terminal formatting."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200", "CUDA_VISIBLE_DEVICES": ""}
    script = Path(sys.executable).parent / str(command[0])
    done = subprocess.run(
        [script, *command[1:]], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    output = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", done.stdout + done.stderr)
    assert (done.returncode != 0) == fails, output[-3000:]
    return output


def simulate(folder: Path, *options: str) -> Path:
    size = ("--width", "48", "--height", "36", "--train-images", "4", "--validation-views", "4", "--test-views", "3")
    run("aenerf", "simulate", "--output", folder, *size, *options, cwd=folder.parent)
    return folder


def newest_config(folder: Path) -> Path:
    return max(folder.rglob("config.yml"), key=lambda path: path.stat().st_mtime)


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
    assert len(list(pictures.glob("eval_img_*.png"))) == 3
    return json.loads(output.read_text())


@pytest.fixture(scope="module")
def evaluated(trained: Path, workspace: Path) -> dict:
    """What ns-eval says of the run that all tests look at."""
    return evaluate(trained, workspace, "trained")


def test_simulated_dataset_is_seeded(workspace: Path) -> None:
    options = ("--speed", "hard", "--pose-noise-degrees", "1", "--pose-noise-translation", "0.05", "--pose-rate", "50")
    first = simulate(workspace / "first", *options, "--bayer-pattern", "RGGB", "--contrast-threshold-spread", "0.03")
    again = simulate(workspace / "again", *options, "--bayer-pattern", "RGGB", "--contrast-threshold-spread", "0.03")
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for name in files:
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    estimated, truth = (np.loadtxt(first / f"trajectory_{name}.txt") for name in ("estimated", "ground_truth"))
    np.testing.assert_array_equal(estimated[:, 0], truth[:, 0])
    error = np.linalg.norm(estimated[:, 1:4] - truth[:, 1:4], axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(0.05, rel=1e-6)
    assert "folder exists already" in run("aenerf", "simulate", "--output", first, cwd=workspace, fails=True)


def test_training_beats_an_untrained_field_on_held_out_views(evaluated: dict, workspace: Path) -> None:
    results = evaluated["results"]
    assert results["color_correction"] == "affine, fitted on 4 validation views"
    assert results["num_views"] == 3
    assert results["lpips"] is None
    assert results["lpips_absent"]
    # The given poses are the true ones.
    assert results["pose_errors"]["estimated"]["rotation_error_degrees"] < 1e-5
    assert results["test_poses"] == "Sim(3) of the corrected to the true trajectory"
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
    options = ("--color-correction", "network", "--test-poses", "photometric", "--render-output", pictures)
    run("aenerf", "evaluate", "--load-config", trained, "--output", output, *options, cwd=workspace)
    written = json.loads(output.read_text())
    # The layout of ns-eval, and what it was computed with.
    assert written.pop("protocol") == {
        "color_correction": "network",
        "color_correction_of_run": "affine",
        "test_poses": "photometric",
    }
    results, of_run = written.pop("results"), evaluated["results"]
    assert written == {key: value for key, value in evaluated.items() if key != "results"}
    assert results.keys() == of_run.keys()
    assert results["color_correction"] == "network, fitted on 4 validation views"
    assert results["test_poses"].startswith("photometric refinement, 100 steps, from: Sim(3)")
    # The same pictures in other colours, from other places.
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
        output = workspace / "poses.txt"
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


def test_neither_images_nor_ground_truth_are_trained_on(trained: Path, workspace: Path) -> None:
    changed = workspace / "changed"
    shutil.copytree(workspace / "room", changed)
    (changed / "events.gone").rename(changed / "events.h5")
    original = workspace / "original"
    shutil.copytree(changed, original)
    # Other true poses, far from the estimated ones: they may change what is reported and nothing else.
    truth = np.loadtxt(changed / "trajectory_ground_truth.txt")
    truth[:, 1:4] = 3 * truth[::-1, 1:4]
    np.savetxt(changed / "trajectory_ground_truth.txt", truth, fmt="%.9f")
    for image in changed.rglob("*.png"):
        imageio.imwrite(image, np.zeros_like(imageio.imread(image)))
    weights = []
    for data in (original, changed):
        run(
            "ns-train",
            "aenerf-small",
            *CPU,
            "--vis",
            "tensorboard",
            "--max-num-iterations",
            "4",
            "--optimizers.camera-opt.scheduler.delay",
            "0",
            "--data",
            data,
            cwd=workspace,
        )
        (checkpoint,) = (workspace / "outputs" / data.name).rglob("*.ckpt")
        weights.append(torch.load(checkpoint, weights_only=True)["pipeline"])
    for name, value in weights[0].items():
        if "color_correction" not in name:
            assert torch.equal(value, weights[1][name]), name
    assert weights[0]["_model.camera_optimizer.twists.control_twists"].any()
    assert not torch.equal(*(w["_model.color_correction.offset"] for w in weights))


@pytest.mark.parametrize(
    ("method", "small"),
    [
        ("aenerf", ("--pipeline.model.log2-hashmap-size", "12")),
        ("aenerf-mlp", ("--pipeline.model.hidden-dim", "32", "--pipeline.model.proposal-hidden-dim", "16")),
    ],
)
def test_the_methods_for_gpus_train_too(trained: Path, workspace: Path, method: str, small: tuple[str, ...]) -> None:
    data = workspace / "original"
    run(
        "ns-train",
        method,
        *CPU,
        "--vis",
        "tensorboard",
        "--max-num-iterations",
        "2",
        "--pipeline.datamanager.train-num-rays-per-batch",
        "60",
        *small,
        "--data",
        data,
        cwd=workspace,
    )
    assert len(list((workspace / "outputs" / "original" / method).rglob("*.ckpt"))) == 1


def test_the_framework_lists_the_methods_and_its_own_still_work(workspace: Path) -> None:
    output = run("ns-train", "--help", cwd=workspace)
    assert "aenerf " in output
    assert "aenerf-mlp" in output
    assert "aenerf-small" in output
    assert "nerfacto" in output
    assert "ecd-data" in run("ns-train", "nerfacto", "--help", cwd=workspace)


def test_a_dataset_that_cannot_be_used_ends_training_with_one_line(workspace: Path) -> None:
    output = run(
        "ns-train",
        "aenerf-small",
        *CPU,
        "--vis",
        "tensorboard",
        "--data",
        workspace / "nothing",
        cwd=workspace,
        fails=True,
    )
    assert "Traceback" not in output
    errors = [line for line in output.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1
    assert "nothing/transforms.json: there is no such file" in errors[0]


def test_training_that_diverges_ends_with_one_line(workspace: Path) -> None:
    data = simulate(workspace / "diverging")
    output = run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", "20", "--data", data,
        "--optimizers.networks.optimizer.lr", "1e30",
        cwd=workspace, fails=True,
    )  # fmt: skip
    assert "Traceback" not in output
    (error,) = [line for line in output.splitlines() if line.startswith("Error: ")]
    assert re.match(r"Error: step \d+: (loss|gradient) not finite \(", error)


def test_a_recording_without_reference_views_trains_and_says_so_at_evaluation(trained: Path, workspace: Path) -> None:
    none = ("--train-images", "0", "--validation-views", "0", "--test-views", "0")
    data = simulate(workspace / "bare", *none, "--scene", "object")
    run(
        "ns-train", "aenerf-small", *CPU, "--vis", "tensorboard", "--max-num-iterations", "3", "--data", data,
        cwd=workspace,
    )  # fmt: skip
    config = newest_config(workspace / "outputs" / "bare")
    # What can be evaluated is the poses, as long as the true ones are known.
    command = ("ns-eval", "--load-config", config, "--output-path", workspace / "none.json")
    run(*command, cwd=workspace)
    results = json.loads((workspace / "none.json").read_text())["results"]
    assert results["num_views"] == 0
    assert "psnr" not in results
    assert results["pose_errors"]["corrected"]["rotation_error_degrees"] < 1
    (data / "trajectory_ground_truth.txt").unlink()
    output = run(*command, cwd=workspace, fails=True)
    assert "Error: " in output
    assert "the test split has no reference images to evaluate on" in output
    # The renderers start from places on the trajectory then.
    for mode in (("spiral", "--seconds", "0.1"), ("interpolate", "--interpolation-steps", "1")):
        video = workspace / f"bare_{mode[0]}.mp4"
        options = ("--load-config", config, "--output-path", video, "--downscale-factor", "4")
        run("ns-render", *mode, *options, cwd=workspace)
        assert video.stat().st_size > 0
