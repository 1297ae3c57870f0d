"""Training on a GPU: where there is one, for real; anywhere, that the model mixes no tensors of two devices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import run, simulate
from nerfstudio.cameras.rays import RayBundle
from small_models import make_batch, make_model, make_rays
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.supervision.pairs import PairSupervisionConfig

GPU = torch.device("cuda:0")
NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def on_gpu(tensor: Tensor, mode: FakeTensorMode) -> Tensor:
    """A tensor without values that takes itself to be on a GPU, and refuses operations with one that does not."""
    with mode:
        return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=GPU)


def move_to_gpu(model: torch.nn.Module, mode: FakeTensorMode) -> None:
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                module._parameters[name] = torch.nn.Parameter(on_gpu(parameter, mode))
        for name, buffer in module._buffers.items():
            if buffer is not None:
                module._buffers[name] = on_gpu(buffer, mode)


def rays_on_gpu(count: int, mode: FakeTensorMode) -> RayBundle:
    rays = make_rays(count, with_times=True)
    for name in ("origins", "directions", "pixel_area", "camera_indices", "times"):
        setattr(rays, name, on_gpu(getattr(rays, name), mode))
    rays.metadata = {name: on_gpu(value, mode) for name, value in rays.metadata.items()}
    return rays


# Without the temporal loss and the gradients: such tensors cannot be differentiated.
@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("correction", ["off", "network", "spline"])
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("backbone", ["hash", "mlp"])
def test_whatever_the_model_computes_with_is_on_its_device(
    backbone: str, bounded: bool, correction: str, learned: bool
) -> None:
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    options: dict[str, Any] = {"proposal": {"num_samples_per_ray": (16, 8)}} if backbone == "mlp" else {}
    model = make_model(
        SensorModel(bayer_pattern="RGGB"),
        bounded=bounded,
        backbone=backbone,
        camera_optimizer=PoseCorrectionConfig(mode=correction),
        supervision=PairSupervisionConfig(learn_contrast_threshold_ratio=learned, learn_refractory_period=learned),
        **options,
    )
    move_to_gpu(model, mode)
    rays = rays_on_gpu(10, mode)
    batch = {name: on_gpu(value, mode) for name, value in make_batch(5).items()}
    with mode:
        losses = model.get_loss_dict(model(rays), batch)
    assert {loss.device for loss in losses.values()} == {GPU}


def test_a_tensor_left_on_the_cpu_would_be_noticed() -> None:
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    model = make_model(camera_optimizer=PoseCorrectionConfig(mode="spline"))
    move_to_gpu(model, mode)
    model.camera_optimizer._twist_units = torch.ones(6)
    with pytest.raises(RuntimeError, match="same device"), mode:
        model(rays_on_gpu(10, mode))


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
    # Better than grey, and poses that have not been thrown about.
    results = json.loads(output.read_text())["results"]
    assert results["psnr"] > 5
    assert results["pose_errors"]["corrected"]["rotation_error_degrees"] < 5
