"""The registered methods: how they differ from each other, and that each of them trains."""

from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from helpers.small_models import SMALL_FIELD, SMALL_PROPOSAL
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig

from aenerf_ns.cli.simulate import Simulate
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method_configs import peers
from aenerf_ns.method_configs.aenerf import aenerf, aenerf_small
from aenerf_ns.method_configs.aenerf_mlp import aenerf_mlp, aenerf_mlp_small
from aenerf_ns.training.pipeline import AENeRFPipeline

SMALL = [
    peers.robust_enerf_small, peers.eventnerf_small, peers.evnerf_small, peers.paev3d_small, peers.e2vid_nerf_small
]  # fmt: skip


def with_options(config: TrainerConfig, *options: str) -> TrainerConfig:
    """The configuration that ns-train makes of options on the command line."""
    return tyro.cli(type(config), args=list(options), default=deepcopy(config), config=(tyro.conf.FlagConversionOff,))


def shrunk(config: TrainerConfig) -> TrainerConfig:
    """The method with tiny networks and batches, and rates that show something in few steps."""
    config.pipeline.datamanager.train_num_rays_per_batch = 60
    config.pipeline.model.field = FieldConfig(**SMALL_FIELD)
    config.pipeline.model.proposal = ProposalConfig(**SMALL_PROPOSAL)
    for group in config.optimizers.values():
        group["scheduler"].warm_up = 0
        if hasattr(group["scheduler"], "delay"):
            group["scheduler"].delay = 0
    return config


def train(config: TrainerConfig, data: Path, num_steps: int) -> tuple[list[dict[str, float]], AENeRFPipeline]:
    """Trains, and returns the losses of each step, and the pipeline."""
    config.pipeline.datamanager.dataparser = NativeDataParserConfig(data=data)
    torch.manual_seed(0)
    pipeline = config.pipeline.setup(device="cpu", test_mode="val")
    groups = pipeline.get_param_groups()
    optimizers = Optimizers({name: config.optimizers[name] for name in groups}, groups)
    history = []
    for step in range(num_steps):
        optimizers.zero_grad_all()
        _, losses, _ = pipeline.get_train_loss_dict(step)
        sum(losses.values()).backward()
        optimizers.optimizer_step_all()
        optimizers.scheduler_step_all(step)
        history.append({name: loss.item() for name, loss in losses.items()})
    return history, pipeline


@pytest.mark.parametrize("config", [shrunk(deepcopy(aenerf_mlp.config)), deepcopy(aenerf_mlp_small.config)])
def test_the_papers_recipe_trains_by_its_losses_alone(config: TrainerConfig, native: Path) -> None:
    history, pipeline = train(config, native, 3)
    assert pipeline.model.warp is None
    assert set(history[-1]) == {"reconstruction_loss", "temporal_loss", "interlevel_loss", "distortion_loss"}
    assert all(history[-1].values())


AS_ROBUST = (
    "--pipeline.datamanager.sampler.max-events-per-pair", "1",
    "--pipeline.datamanager.sampler.silent-pair-share", "0",
    "--pipeline.model.camera-optimizer.mode", "off",
    "--pipeline.model.average-init-density", "1",
    "--pipeline.model.supervision.allow-for-bandwidth", "False",
)  # fmt: skip


@pytest.mark.parametrize(("robust", "ours"), [(peers.robust_enerf, aenerf), (peers.robust_enerf_small, aenerf_small)])
def test_robust_enerf_is_aenerf_with_options(robust: Any, ours: Any) -> None:
    as_robust = with_options(ours.config, *AS_ROBUST)
    as_robust.method_name = robust.config.method_name
    assert asdict(as_robust) == asdict(robust.config)


@pytest.mark.parametrize("mode", ["off", "spline"])
@pytest.mark.parametrize("method", SMALL, ids=lambda method: method.config.method_name)
def test_peers_train_with_and_without_correction(method: Any, mode: str, native: Path) -> None:
    config = with_options(method.config, "--pipeline.model.camera-optimizer.mode", mode)
    history, pipeline = train(shrunk(config), native, 3)
    assert len({losses["reconstruction_loss"] for losses in history}) == 3
    # Ev-NeRF also learns the thresholds, which begin as the dataset's.
    assert pipeline.model.supervision.learned_values().get("positive_threshold") != pytest.approx(0.3, abs=1e-3)
    correction = dict(pipeline.model.camera_optimizer.named_parameters())
    assert list(correction) == ([] if mode == "off" else ["twists.control_twists"])
    assert all(parameter.any() for parameter in correction.values())


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory, small_work: None) -> Path:
    """The built-in object, with poses that are a little wrong."""
    folder = tmp_path_factory.mktemp("simulated") / "object"
    images = {"train_images": 16, "validation_views": 8, "test_views": 2}
    noise = {"pose_noise_degrees": 0.5, "pose_noise_translation": 0.02}
    Simulate(folder, scene="object", width=64, height=48, max_displacement=1.0, **images, **noise).main()
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["off", "spline"])
@pytest.mark.parametrize("method", SMALL, ids=lambda method: method.config.method_name)
def test_peers_reconstruct_a_simulated_scene(method: Any, mode: str, simulated: Path) -> None:
    # E2VID + NeRF trains on the dataset's true images, because this is a test of the training.
    config = with_options(method.config, "--pipeline.model.camera-optimizer.mode", mode)
    psnr = []
    for num_steps in (0, 250):
        _, pipeline = train(config, simulated, num_steps)
        pipeline.color_fit.fit()
        psnr.append(pipeline.get_average_eval_image_metrics()["psnr"])
    assert psnr[1] > psnr[0] + 2
