"""No NaN and no infinity reaches a weight: extreme scenes and batches, mixed precision, and the guard behind them."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays
from helpers.small_trainings import train_small_model
from nerfstudio.cameras.rays import RayBundle, RaySamples
from torch import Tensor, nn

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.supervision.event_pairs import PairBatch, PairLossCoefficients
from aenerf_ns.training.trainer import AENeRFTrainer


def set_output(network: nn.Module, value: float) -> None:
    """Makes a network's first output the same everywhere."""
    layer = network.layers[-1]
    with torch.no_grad():
        layer.weight[0] = 0
        layer.bias[0] = value


def set_proposal_density(model: AENeRFModel, raw: float) -> None:
    proposal = model.proposal_networks[0]
    set_output(proposal.mlp_base[1] if model.config.backbone == "hash" else proposal.density_network, raw)


def set_density(model: AENeRFModel, raw: float) -> None:
    set_output(model.field.density_network, raw)
    set_proposal_density(model, raw)


def set_radiance(model: AENeRFModel, raw: float) -> None:
    set_output(model.field.radiance_network, raw)
    if model.raw_background is not None:
        torch.nn.init.constant_(model.raw_background, raw)


def moved_to(position: float) -> Callable[[RayBundle], RayBundle]:
    return lambda rays: replace(rays, origins=torch.full((len(rays), 3), position))


def turned_away(rays: RayBundle) -> RayBundle:
    camera_directions = -rays.metadata["camera_directions"]
    return replace(rays, directions=-rays.directions, metadata={"camera_directions": camera_directions})


def counts(positive: float, negative: float) -> Callable[[PairBatch], PairBatch]:
    return lambda batch: replace(
        batch,
        num_positive=torch.full_like(batch.num_positive, positive),
        num_negative=torch.full_like(batch.num_negative, negative),
    )


def interval(seconds: float) -> Callable[[PairBatch], PairBatch]:
    return lambda batch: replace(batch, last_interval=torch.full_like(batch.last_interval, seconds))


CASES: dict[str, dict[str, Any]] = {
    "an interval of one nanosecond": {"batch": interval(1e-9)},
    "an interval of no length": {"batch": interval(0.0)},
    "an interval of a day": {"batch": interval(86400.0)},
    "events that cancel": {"batch": counts(3, 2)},
    "pairs of no events": {"batch": counts(0, 0)},
    "a thousand merged events": {"batch": counts(1000, 0)},
    "no density": {"model": lambda model: set_density(model, -1e4)},
    "density that underflows": {"model": lambda model: set_density(model, -100.0)},
    "density that overflows": {"model": lambda model: set_density(model, 1e4)},
    "density of proposals that overflows": {"model": lambda model: set_proposal_density(model, 100.0)},
    "radiance that underflows": {"model": lambda model: set_radiance(model, -200.0)},
    "huge radiance": {"model": lambda model: set_radiance(model, 1e30)},
    "rays from afar": {"rays": moved_to(50.0)},
    "rays from the center": {"rays": moved_to(0.0)},
    "rays that miss": {"rays": turned_away},
    "a single pair": {"pairs": 1},
}


# Whether the scene is bounded, the backbone, the pose correction, and whether the temporal loss is on.
KINDS = [
    (True, "hash", "off", True),
    (False, "hash", "off", False),
    (True, "hash", "network", True),
    (False, "hash", "spline", True),
    (True, "mlp", "off", False),
    (False, "mlp", "spline", True),
]


# The values of the events reach only the losses. One kind of model has all losses.
@pytest.mark.parametrize(
    ("case", "kind"), [(case, kind) for case, parts in CASES.items() for kind in KINDS[: 1 if "batch" in parts else 6]]
)
def test_losses_and_gradients_are_finite(case: str, kind: tuple[bool, str, str, bool]) -> None:
    options, (bounded, backbone, mode, temporal) = CASES[case], kind
    pairs = options.get("pairs", 5)
    model = make_model(
        SensorModel(0.2, 0.3),
        bounded=bounded,
        backbone=backbone,
        camera_optimizer=PoseCorrectionConfig(mode=mode),
        loss_coefficients=PairLossCoefficients(temporal_loss=1e-3 * temporal),
    )
    options.get("model", lambda model: None)(model)
    rays = make_rays((3 if temporal else 2) * pairs, with_times=True)
    rays = options.get("rays", lambda rays: rays)(rays)
    losses = model.get_loss_dict(model(rays), options.get("batch", lambda batch: batch)(make_batch(pairs)))
    assert ("temporal_loss" in losses) == temporal
    for name, loss in losses.items():
        assert torch.isfinite(loss), name
    torch.stack(list(losses.values())).sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all(), name


def losses_and_gradients(model: AENeRFModel, precision: torch.dtype | None) -> tuple[dict, dict]:
    model.zero_grad()
    torch.manual_seed(0)
    with torch.autocast("cpu", precision or torch.bfloat16, enabled=precision is not None):
        outputs = model(make_rays(300, with_times=True))
        losses = model.get_loss_dict(outputs, make_batch(100))
    for name in ("log_radiance", "log_radiance_rate"):
        assert outputs[name].dtype == torch.float32
    # As the trainer's scaler does: without it, gradients of the proposals underflow in float16.
    scale = 2.0**16
    (scale * torch.stack(list(losses.values())).sum()).backward()
    gradients = {name: p.grad / scale for name, p in model.named_parameters() if p.grad is not None}
    return losses, gradients


# Unit roundoff is 2⁻⁸ and 2⁻¹¹.
@pytest.mark.parametrize(("precision", "tolerance"), [(torch.bfloat16, 1e-2), (torch.float16, 2e-3)])
@pytest.mark.parametrize(("backbone", "mode"), [("hash", "network"), ("hash", "spline"), ("mlp", "network")])
def test_mixed_precision_is_near_full_precision(
    backbone: str, mode: str, precision: torch.dtype, tolerance: float
) -> None:
    model = make_model(
        backbone=backbone, camera_optimizer=PoseCorrectionConfig(mode=mode), loss_coefficients=ALL_LOSSES
    )
    for name, parameter in model.named_parameters():
        if name.endswith("hash_table"):
            torch.nn.init.uniform_(parameter, -1, 1)
    # Denser than the proposals, or their loss has no gradient.
    model.field.average_init_density = 5.0
    expected_losses, expected = losses_and_gradients(model, None)
    losses, gradients = losses_and_gradients(model, precision)
    for name, loss in losses.items():
        torch.testing.assert_close(loss, expected_losses[name], rtol=tolerance, atol=0)
    assert set(gradients) == set(expected)
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), name
        # Those of biases are sums that cancel.
        if not name.endswith("bias"):
            assert (gradient - expected[name]).norm() <= 5 * tolerance * expected[name].norm(), name


def test_the_pose_correction_keeps_full_precision() -> None:
    # In half precision the ends of a short interval would get one correction, and no rate of change.
    model = make_model(camera_optimizer=PoseCorrectionConfig(mode="network"))
    torch.nn.init.normal_(model.camera_optimizer.twists.output.weight, std=0.01)
    seconds = torch.tensor([0.5, 0.5001], dtype=torch.float64)
    with torch.autocast("cpu", torch.bfloat16):
        pose = model.camera_optimizer.pose(seconds)
    torch.testing.assert_close(pose, model.camera_optimizer.pose(seconds), rtol=0, atol=0)


def make_samples(model: AENeRFModel, rays: RayBundle) -> RaySamples:
    return model.proposal_sampler(model.collider(rays), density_fns=model.density_fns)[0]


def test_the_rate_keeps_full_precision() -> None:
    model = make_model()
    rays = make_rays(20)
    samples = make_samples(model, rays)
    # So fast that rates of features exceed the range of half precision.
    rates = torch.randn(2, 20, 3) * 1e8
    model.camera_optimizer.ray_rates = lambda _: tuple(rates)
    values = []
    for enabled in (False, True):
        with torch.autocast("cpu", torch.float16, enabled=enabled):
            values.append(model._composite_with_rate(samples, rays)[1])
    assert values[0].abs().max() > 1e3
    assert torch.equal(*values)


def test_density_does_not_overflow_in_mixed_precision() -> None:
    model = make_model()
    # Its exponential is beyond the range of float16.
    set_density(model, 13.0)
    samples = make_samples(model, make_rays(20))
    with torch.autocast("cpu", torch.float16):
        for network in (model.field, *model.proposal_networks):
            density, _ = network.get_density(samples)
            assert density.max().item() == pytest.approx(network.average_init_density * math.exp(13), rel=1e-4)


def train_and_spoil(
    folder: Path, spoil: Callable[[AENeRFTrainer], object], message: str
) -> list[tuple[Tensor, Tensor]]:
    """Assert that training ends with a message if it is spoiled at step 7. Return all weights, and as they were."""
    weights = []

    def prepare(trainer: AENeRFTrainer) -> None:
        datamanager = trainer.pipeline.datamanager
        draw = datamanager.next_train

        def next_train(step: int) -> Any:
            if step == 7:
                spoil(trainer)
                weights.extend((parameter, parameter.detach().clone()) for parameter in trainer.pipeline.parameters())
            return draw(step)

        datamanager.next_train = next_train

    with pytest.raises(SystemExit, match=message):
        train_small_model(folder, "run", 10, prepare=prepare)
    (file,) = folder.rglob("run.json")
    record = json.loads(file.read_text())
    assert (record["state"], record["steps"]) == ("stopped", 7)
    return weights


@pytest.mark.parametrize("mixed", [False, True])
def test_a_loss_that_is_not_finite_ends_training_with_its_name(mixed: bool, tmp_path: Path) -> None:
    def spoil(trainer: AENeRFTrainer) -> None:
        trainer.grad_scaler = torch.amp.GradScaler("cpu", enabled=mixed)
        trainer.pipeline.model.field.radiance_network.layers[-1].bias.data.fill_(math.nan)

    weights = train_and_spoil(tmp_path, spoil, r"^Error: step 7: loss not finite \(reconstruction_loss nan\), .*$")
    for now, before in weights:
        assert torch.equal(now.isfinite(), before.isfinite())


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_a_gradient_that_is_not_finite_does_not_reach_the_weights(value: float, tmp_path: Path) -> None:
    def spoiled(gradient: Tensor) -> Tensor:
        # Of 1e30 the square, which Adam takes, overflows.
        return gradient.index_put((torch.tensor(3), torch.tensor(1)), torch.tensor(value))

    weights = train_and_spoil(
        tmp_path,
        lambda trainer: trainer.pipeline.model.field.encoding.hash_table.register_hook(spoiled),
        r"^Error: step 7: gradient not finite \(field.encoding.hash_table ",
    )
    assert all(torch.equal(now, before) for now, before in weights)
