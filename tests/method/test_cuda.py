"""Training on a GPU: where there is one, for real; anywhere, on a simulated one, with the cost of a step."""

import json
from collections import defaultdict
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.commands import run, simulate
from helpers.simulated_cuda import NEEDS_SIMULATION, Counts, SimulatedCuda, device, to_device
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from helpers.small_pipelines import make_pipeline_config
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.hash_grid import HashEncoding
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.supervision.base import Supervision, SupervisionConfig
from aenerf_ns.supervision.event_pairs import PairSupervisionConfig
from aenerf_ns.supervision.peers.paev3d import PAEv3DSupervision, PatchBatch
from aenerf_ns.supervision.peers.windows import EventNeRFSupervision, EvNeRFSupervision
from benchmarks.step.worker import train_steps

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@NEEDS_SIMULATION
@pytest.mark.parametrize(
    ("backbone", "bounded", "correction", "learned"),
    # Any two of the values meet.
    [
        ("hash", False, "off", False),
        ("hash", True, "network", False),
        ("hash", False, "spline", False),
        ("hash", True, "spline", True),
        ("mlp", True, "off", True),
        ("mlp", False, "network", True),
        ("mlp", True, "spline", False),
    ],
)
def test_a_step_computes_on_the_device_alone(backbone: str, bounded: bool, correction: str, learned: bool) -> None:
    options: dict[str, Any] = {"proposal": {"num_samples_per_ray": (16, 8)}} if backbone == "mlp" else {}
    model = make_model(
        SensorModel(bayer_pattern="RGGB", bandwidth=0.0 if learned else 100.0),
        bounded=bounded,
        backbone=backbone,
        camera_optimizer=PoseCorrectionConfig(mode=correction),
        supervision=PairSupervisionConfig(learn_contrast_threshold_ratio=learned, learn_refractory_period=learned),
        loss_coefficients=ALL_LOSSES,
        **options,
    )
    with SimulatedCuda() as gpu:
        to_device(model)
        rays, batch = to_device(make_rays(15, with_times=True)), to_device(make_batch(5))
        losses = model.get_loss_dict(model(rays), batch)
        torch.stack(list(losses.values())).sum().backward()
    assert {loss.device for loss in losses.values()} == {device()}
    assert sum(gpu.counts.launches.values()) > 100
    assert gpu.counts.uploads == gpu.counts.downloads == gpu.counts.waits == 0


@NEEDS_SIMULATION
@pytest.mark.parametrize("supervision", [EventNeRFSupervision, EvNeRFSupervision, PAEv3DSupervision])
def test_a_step_on_windows_computes_on_the_device_alone(supervision: type[Supervision]) -> None:
    config = SupervisionConfig(_target=supervision)
    model = make_model(camera_optimizer=PoseCorrectionConfig(mode="spline"), supervision=config)
    with SimulatedCuda() as gpu:
        to_device(model)
        one, zero = torch.ones(4), torch.zeros(4, dtype=torch.long)
        parts = {"window": zero, "displacement": torch.ones(4, 2)} if model.supervision.batch_type is PatchBatch else {}
        rays = to_device(make_rays(8, with_times=True))
        batch = to_device(model.supervision.batch_type(one, one, zero, **parts))
        outputs = model(rays)
        torch.stack(list(model.get_loss_dict(outputs, batch).values())).sum().backward()
        assert model.supervision.metrics(outputs, batch)["polarity_agreement"].device == device()
    assert sum(gpu.counts.launches.values()) > 100
    assert gpu.counts.uploads == gpu.counts.downloads == gpu.counts.waits == 0


@NEEDS_SIMULATION
def test_tensors_left_on_the_cpu_transfers_and_waits_would_be_noticed() -> None:
    model = make_model(camera_optimizer=PoseCorrectionConfig(mode="spline"))
    with SimulatedCuda() as gpu:
        to_device(model)
        model.camera_optimizer._twist_units = torch.ones(6)
        with pytest.raises(RuntimeError, match="same device"):
            model(to_device(make_rays(10, with_times=True)))
        gpu.counts = Counts()
        values = torch.arange(3.0).to(device())
        torch.zeros(3, device=device()).copy_(torch.ones(3))
        assert values.tolist() == [0.0, 1.0, 2.0]
        values.cpu()
        values.sum().item()
        values[values > 0]
    assert (gpu.counts.uploads, gpu.counts.downloads, gpu.counts.waits) == (2, 3, 1)
    assert gpu.counts.launches == {"zeros": 1, "sum": 1, "gt": 1, "index": 1}


def make_trainer(folder: Path, narrow: bool, temporal: bool) -> Trainer:
    """A trainer of the method aenerf, without what belongs to files and logs.

    Every batch is the same, and on the device.
    """
    config = deepcopy(aenerf.config)
    config.pipeline.datamanager.dataparser = make_pipeline_config(folder).datamanager.dataparser
    model = config.pipeline.model
    model.loss_coefficients = replace(model.loss_coefficients, temporal_loss=1e-3 * temporal)
    if narrow:
        config.pipeline.datamanager.train_num_rays_per_batch = 60
        model.field.log2_hashmap_size, model.field.num_samples_per_ray = 10, 6
        model.proposal.log2_hashmap_size, model.proposal.num_samples_per_ray = 8, (16, 8)
    config.schedule_length = config.max_num_iterations
    trainer = Trainer.__new__(Trainer)
    trainer.config, trainer.device, trainer.mixed_precision = config, device().type, False
    trainer.local_rank, trainer._start_step = 1, 0
    trainer.gradient_accumulation_steps = defaultdict(lambda: 1, config.gradient_accumulation_steps)
    trainer.grad_scaler = torch.amp.GradScaler("cpu", enabled=False)
    trainer.pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    batch = trainer.pipeline.datamanager.next_train(0)
    trainer.pipeline.datamanager.next_train = lambda step: tuple(map(to_device, batch))
    return trainer


def move_to_device(trainer: Trainer) -> None:
    """Moves the model of a trainer, and makes its optimizers."""
    pipeline = trainer.pipeline
    to_device(pipeline.model)
    trainer.optimizers = Optimizers(trainer.config.optimizers, pipeline.get_param_groups())
    trainer.callbacks = pipeline.get_training_callbacks(SimpleNamespace(trainer=trainer))


def train(trainer: Trainer, gpu: SimulatedCuda, step: int) -> Counts:
    trainer.step, gpu.counts = step, Counts()
    train_steps(trainer, 1)
    return gpu.counts


class CountedKernel:
    """Stands for a Triton kernel of the hash grid, and counts it."""

    def __init__(self, gpu: SimulatedCuda, bytes_per_point: int) -> None:
        self.gpu = gpu
        self.bytes_per_point = bytes_per_point

    def __getitem__(self, grid: tuple[int, int]) -> Any:
        def launch(positions: Tensor, tangents: Tensor | None, table: Tensor, scales: Tensor, *_: Any, **__: Any):
            num_bytes = len(positions) * len(scales) * self.bytes_per_point * (1 if tangents is None else 2)
            self.gpu.counts.kernel("hash grid", num_bytes)

        return launch


@NEEDS_SIMULATION
@pytest.mark.parametrize("temporal", [False, True])
def test_a_step_waits_once_and_copies_nothing_else(temporal: bool, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path / "data", narrow=True, temporal=temporal)
    with SimulatedCuda() as gpu:
        move_to_device(trainer)
        parameters = list(trainer.pipeline.model.field.parameters())
        before = [parameter.on_cpu.clone() for parameter in parameters]
        # At step 23 the pose correction is stepped, too.
        counts = [train(trainer, gpu, step) for step in range(16, 24) if step != 20]
    assert not any(torch.equal(parameter.on_cpu, value) for parameter, value in zip(parameters, before, strict=True))
    # Losses and gradients, all together.
    assert [count.downloads for count in counts] == [1] * len(counts)
    assert [count.uploads for count in counts] == [0] * len(counts)
    assert [count.waits for count in counts] == [0] * len(counts)


# Bounds on the means over a step with gradients of the proposal networks and a step without, in which the pose
# correction is stepped. They are what was counted, rounded. The field counts rays, as in the first part of a run. The
# bytes of the Triton kernels are by formula: positions, features and their gradients come from memory, the tables from
# the cache.
@NEEDS_SIMULATION
@pytest.mark.parametrize(("temporal", "launches", "gigabytes"), [(False, 881, 14.6), (True, 1637, 20.6)])
def test_what_a_step_of_the_full_method_costs(
    temporal: bool, launches: int, gigabytes: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("triton")
    from aenerf_ns.method.kernels import hash_grid_triton

    trainer = make_trainer(tmp_path / "data", narrow=False, temporal=temporal)
    with FakeTensorMode(allow_non_fake_inputs=True), SimulatedCuda() as gpu:
        monkeypatch.setattr(hash_grid_triton, "_fill_features", CountedKernel(gpu, 20))
        monkeypatch.setattr(hash_grid_triton, "_add_gradients", CountedKernel(gpu, 32))
        monkeypatch.setattr(HashEncoding, "_choose", lambda self, positions: hash_grid_triton)
        move_to_device(trainer)
        # The optimizers make their states in the first step, and at step 7 all of them step.
        train(trainer, gpu, 7)
        counts = [train(trainer, gpu, step) for step in (22, 23)]
    assert sum(sum(count.launches.values()) for count in counts) / 2 <= launches
    assert sum(count.bytes for count in counts) / 2 <= (gigabytes + 0.05) * 1e9


@NEEDS_GPU
@pytest.mark.parametrize("precision", ["False", "True"])
@pytest.mark.parametrize("method", ["aenerf-small", "aenerf-mlp"])
def test_a_run_is_trained_resumed_and_evaluated(method: str, precision: str, tmp_path: Path) -> None:
    simulate(tmp_path / "data", "--scene", "room", "--pose-noise-degrees", "1")
    train = (
        "ns-train", method, "--mixed-precision", precision, "--vis", "tensorboard", "--output-dir", tmp_path / "out",
        "--max-num-iterations", "60", "--pipeline.model.loss-coefficients.temporal-loss", "1e-3",
        "--pipeline.model.camera-optimizer.mode", "spline", "--pipeline.datamanager.train-num-rays-per-batch", "510",
    )  # fmt: skip
    run(*train, "aenerf-data", "--data", tmp_path / "data", cwd=tmp_path, gpu=True)
    (checkpoints,) = (tmp_path / "out").rglob("nerfstudio_models")
    run(*train, "--load-dir", checkpoints, "aenerf-data", "--data", tmp_path / "data", cwd=tmp_path, gpu=True)
    config = max((tmp_path / "out").rglob("config.yml"))
    output = tmp_path / "evaluation.json"
    run("ns-eval", "--load-config", config, "--output-path", output, cwd=tmp_path, gpu=True)
    # Better than gray, and poses that have not been thrown about.
    results = json.loads(output.read_text())["results"]
    assert results["psnr"] > 5
    assert results["pose_errors"]["corrected"]["rotation_error_degrees"] < 5
