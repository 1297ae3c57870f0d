"""Datasets and trainings of all kinds, through the real commands."""

import json
import shutil
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from helpers.commands import CPU, newest_config, run, simulate
from helpers.small_trainings import own_log
from nerfstudio.scripts import train
from nerfstudio.scripts.render import RenderInterpolated, SpiralRender
from nerfstudio.utils import writer

from aenerf_ns.cli.evaluate import Evaluate
from aenerf_ns.errors import DataError
from aenerf_ns.method_configs.aenerf import aenerf_small
from aenerf_ns.training.trainer import AENeRFTrainerConfig


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, small_work: None) -> Path:
    return tmp_path_factory.mktemp("workspace")


@pytest.fixture(scope="module")
def room(workspace: Path) -> Path:
    """A tiny simulated room."""
    return simulate(workspace / "room")


def train_here(config: AENeRFTrainerConfig, data: Path, folder: Path, vis: str = "tensorboard") -> None:
    """Trains on the CPU in this process, as ns-train does in a folder."""
    config.data, config.output_dir, config.vis = data, folder / "outputs", vis
    config.machine.device_type = "cpu"
    with own_log():
        train.main(config)


def test_simulated_dataset_is_seeded(workspace: Path) -> None:
    options = (
        "--speed", "hard", "--pose-noise-degrees", "1", "--pose-noise-translation", "0.05", "--pose-rate", "50",
        "--bayer-pattern", "RGGB", "--contrast-threshold-spread", "0.03", "--width", "24", "--height", "18",
    )  # fmt: skip
    first, again = (simulate(workspace / name, *options) for name in ("first", "again"))
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for name in files:
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    estimated, truth = (np.loadtxt(first / f"trajectory_{name}.txt") for name in ("estimated", "ground_truth"))
    np.testing.assert_array_equal(estimated[:, 0], truth[:, 0])
    error = np.linalg.norm(estimated[:, 1:4] - truth[:, 1:4], axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(0.05, rel=1e-6)


def test_neither_images_nor_ground_truth_are_trained_on(room: Path, workspace: Path) -> None:
    changed = workspace / "changed"
    shutil.copytree(room, changed)
    # Other true poses, far from the estimated ones: they may change what is reported and nothing else.
    truth = np.loadtxt(changed / "trajectory_ground_truth.txt")
    truth[:, 1:4] = 3 * truth[::-1, 1:4]
    np.savetxt(changed / "trajectory_ground_truth.txt", truth, fmt="%.9f")
    for image in changed.rglob("*.png"):
        imageio.imwrite(image, np.zeros_like(imageio.imread(image)))
    weights = []
    for data in (room, changed):
        config = deepcopy(aenerf_small.config)
        config.max_num_iterations = 4
        config.optimizers["camera_opt"]["scheduler"].delay = 0
        config.gradient_accumulation_steps = {"camera_opt": 1}
        train_here(config, data, workspace)
        (checkpoint,) = (workspace / "outputs" / data.name).rglob("*.ckpt")
        weights.append(torch.load(checkpoint, weights_only=True)["pipeline"])
    for name, value in weights[0].items():
        if isinstance(value, torch.Tensor) and "color_correction" not in name:
            assert torch.equal(value, weights[1][name]), name
    assert weights[0]["_extra_state"] == weights[1]["_extra_state"]
    assert weights[0]["_model.camera_optimizer.twists.control_twists"].any()
    assert not torch.equal(*(w["_model.color_correction.offset"] for w in weights))


def train_processes(room: Path, folder: Path, count: int, *options: str) -> list[dict[str, Any]]:
    """Trains in processes that learn all there is besides the scene, and returns what each of them kept."""
    folder.mkdir()
    run(
        "python", Path(__file__).parents[1] / "helpers" / "train_on_cpu_processes.py", "aenerf-small", *CPU,
        "--machine.num-devices", str(count), "--vis", "tensorboard",
        "--optimizers.camera-opt.scheduler.delay", "0",
        "--pipeline.model.supervision.learn-contrast-threshold-ratio", "True",
        "--pipeline.model.supervision.learn-refractory-period", "True",
        "--pipeline.model.loss-coefficients.temporal-loss", "0.001",
        *options, "--data", room,
        cwd=folder,
    )  # fmt: skip
    return [torch.load(folder / f"process_{rank}.pt", weights_only=True) for rank in range(count)]


@pytest.mark.slow
def test_two_processes_learn_the_same_from_different_pairs(
    room: Path, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = workspace / "two"
    first, second = train_processes(
        room, folder, 2, "--max-num-iterations", "3", "--gradient-accumulation-steps.camera-opt", "1",
        "--pipeline.datamanager.train-num-rays-per-batch", "255",
    )  # fmt: skip
    assert not torch.equal(first["times"], second["times"])
    for name, value in first["weights"].items():
        # Only the process that writes the checkpoints fits colors.
        if not name.startswith("color_correction."):
            assert torch.equal(value, second["weights"][name]), name
    # Roughly after the first step, and after the last.
    assert (first["num_fits"], second["num_fits"]) == (2, 0)
    assert first["weights"]["camera_optimizer.twists.control_twists"].any()
    results = workspace / "two.json"
    monkeypatch.chdir(folder)
    Evaluate(newest_config(folder), results).main()
    learned = json.loads(results.read_text())["results"]
    assert learned["contrast_threshold_ratio"] != 1
    assert learned["pose_diagnosis"]["summary"].startswith("Pose correction: ")
    assert learned["num_views"] == 3


@pytest.mark.slow
def test_two_processes_equal_one_with_twice_the_batch(
    room: Path, workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHARED_BATCHES", "1")
    # By plain torch, because every process would compile the quicker implementation.
    grid = ("--pipeline.model.field.grid-implementation", "torch")
    options = ("--max-num-iterations", "4", "--gradient-accumulation-steps.camera-opt", "2", *grid)
    rays = "--pipeline.datamanager.train-num-rays-per-batch"
    (one,) = train_processes(room, workspace / "one", 1, *options, rays, "600")
    halves = train_processes(room, workspace / "halves", 2, *options, rays, "300")
    # The rays at the starts of the pairs, at their ends, and between.
    times = torch.cat([half["times"].unflatten(0, (3, -1)) for half in halves], 1)
    assert torch.equal(times.flatten(0, 1), one["times"])
    for name, value in one["weights"].items():
        start, of_halves = one["before"][name], halves[0]["weights"][name]
        assert torch.equal(halves[0]["before"][name], start), name
        # A half of the rays tells as well where the times see a place: no process waits for the counts of the others.
        if value.is_floating_point() and name != "warp._seen":
            assert (of_halves - value).norm() <= 1e-3 * (value - start).norm(), name
    assert one["weights"]["camera_optimizer.twists.control_twists"].any()


def test_a_folder_that_cannot_be_written_ends_training_with_one_line(tmp_path: Path) -> None:
    # In place of the folder of all runs.
    (tmp_path / "outputs").touch()
    # It is said before the data are read, which may take long.
    with pytest.raises(SystemExit, match=r"^Error: \S+config.yml: it cannot be created \(Not a .*another --output-dir"):
        train_here(deepcopy(aenerf_small.config), tmp_path / "nothing", tmp_path)


def test_a_log_that_needs_a_key_ends_training_with_one_line(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_key(**_: Any) -> None:
        raise ValueError("Comet.ml requires an API key. Set COMET_API_KEY\n")

    # The import of the real one changes the process.
    monkeypatch.setattr(writer, "CometWriter", without_key)
    message = r"^Error: --vis comet: Comet.ml requires an API key. Set COMET_API_KEY; .*another --vis"
    with pytest.raises(SystemExit, match=message):
        train_here(deepcopy(aenerf_small.config), room, tmp_path, vis="comet")


@pytest.fixture(scope="module")
def without_views(workspace: Path) -> tuple[Path, Path]:
    """A recording without reference views, and config.yml of a run on it."""
    none = ("--train-images", "0", "--validation-views", "0", "--test-views", "0")
    data = simulate(workspace / "bare", *none, "--scene", "object")
    config = deepcopy(aenerf_small.config)
    config.max_num_iterations = 3
    train_here(config, data, workspace)
    return data, newest_config(workspace / "outputs" / "bare")


@pytest.mark.slow
@pytest.mark.parametrize(
    "render", [partial(SpiralRender, seconds=0.1), partial(RenderInterpolated, interpolation_steps=1)]
)
def test_rendering_without_reference_views_starts_on_the_trajectory(
    without_views: tuple[Path, Path], tmp_path: Path, render: Any
) -> None:
    video = tmp_path / "video.mp4"
    render(without_views[1], video, downscale_factor=4).main()
    assert video.stat().st_size > 0


def test_evaluation_without_reference_views_is_of_poses(
    without_views: tuple[Path, Path], workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, config = without_views
    monkeypatch.chdir(workspace)
    Evaluate(config, workspace / "none.json").main()
    results = json.loads((workspace / "none.json").read_text())["results"]
    assert results["num_views"] == 0
    assert "psnr" not in results
    assert results["pose_errors"]["corrected"]["rotation_error_degrees"] < 1
    with pytest.raises(DataError, match="it has no test views to predict; leave out --nerfbaselines"):
        Evaluate(config, workspace / "again.json", nerfbaselines=workspace / "baselines").main()
    assert not (workspace / "again.json").exists()
    (data / "trajectory_ground_truth.txt").unlink()
    with pytest.raises(DataError, match="it has no reference images to evaluate on"):
        Evaluate(config, workspace / "again.json").main()
