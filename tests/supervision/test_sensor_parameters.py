"""Learned contrast thresholds and refractory period."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers.small_models import ALL_LOSSES, make_batch, make_model, make_rays, make_sampler
from nerfstudio.model_components.ray_samplers import UniformSampler

from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.supervision.event_pairs import PairBatch, PairLossCoefficients, PairSupervision, PairSupervisionConfig


def make_supervision(sensor: SensorModel, **learned: bool) -> PairSupervision:
    supervision = PairSupervision(PairSupervisionConfig(**learned), sensor, PairLossCoefficients())
    supervision.prepare(SimpleNamespace(pairs=SimpleNamespace(shortest_interval=10_000)))
    return supervision


def test_events_that_cancel_up_to_rounding_have_no_temporal_loss() -> None:
    batch = replace(make_batch(1), last_num_positive=torch.tensor([3.0]), last_num_negative=torch.tensor([2.0]))
    outputs = {"log_radiance": torch.zeros(2, 1), "log_radiance_rate": torch.ones(1, 1)}
    assert make_supervision(SensorModel(0.96, 1.44)).losses(outputs, batch)["temporal_loss"] == 0
    assert make_supervision(SensorModel(0.96, 1.43)).losses(outputs, batch)["temporal_loss"] > 0


@pytest.mark.parametrize("ratio", [1e-3, 0.5, 1.0, 1.458, 40.0])
def test_the_ratio_starts_at_the_given_one(ratio: float) -> None:
    supervision = make_supervision(SensorModel(0.2 * ratio, 0.2), learn_contrast_threshold_ratio=True)
    assert supervision.contrast_threshold_ratio.item() == pytest.approx(ratio, rel=1e-4)
    assert supervision.refractory_period is None


@pytest.mark.parametrize(("given", "expected"), [(0, 5e-6), (2_000, 2e-6), (9_999, 9.999e-6)])
def test_the_refractory_period_starts_at_the_given_one_and_stays_below_the_bound(given: int, expected: float) -> None:
    supervision = make_supervision(SensorModel(refractory_period=given), learn_refractory_period=True)
    assert supervision.refractory_period.item() == pytest.approx(expected, rel=1e-3)
    assert supervision.contrast_threshold_ratio is None
    for raw in (-200.0, 200.0):
        supervision.raw_refractory_period.data.fill_(raw)
        assert 0 <= supervision.refractory_period.item() <= 1e-5


def make_learning_model() -> AENeRFModel:
    model = make_model(
        SensorModel(0.3, 0.2, refractory_period=20_000_000),
        supervision=PairSupervisionConfig(learn_contrast_threshold_ratio=True, learn_refractory_period=True),
        loss_coefficients=ALL_LOSSES,
        far_plane=6.0,
    ).double()
    torch.nn.init.uniform_(model.field.encoding.hash_table, -1, 1)
    model.field.average_init_density = 2.0
    model.supervision.prepare(SimpleNamespace(pairs=SimpleNamespace(shortest_interval=50_000_000)))
    return model


def test_their_gradients_are_those_of_finite_differences() -> None:
    model = make_learning_model().eval()
    # Samples at fixed distances: the framework does not differentiate the places of its own.
    sampler = UniformSampler(num_samples=24).eval()
    model.proposal_sampler.forward = lambda rays, density_fns: (sampler(rays), [], [])
    # A scalar in float64 does not make a float32 batch one.
    values = vars(make_batch(5)).items()
    batch = PairBatch(**{name: value.double() if value.is_floating_point() else value for name, value in values})

    def loss() -> torch.Tensor:
        rays = make_rays(10, with_times=True)
        rays.origins, rays.directions = rays.origins.double(), rays.directions.double()
        outputs = model(rays)
        return model.get_loss_dict(outputs, batch)["reconstruction_loss"]

    for name, parameter in model.supervision.named_parameters():
        (gradient,) = torch.autograd.grad(loss(), parameter)
        values = []
        for step in (1e-5, -1e-5):
            parameter.data += step
            values.append(loss().item())
            parameter.data -= step
        assert gradient.item() == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-3), name
        assert abs(gradient.item()) > 1e-6, name


def test_proposals_and_silent_pixels_tell_nothing_of_thresholds() -> None:
    model = make_learning_model().train()
    ratio = model.supervision.raw_ratio
    batch = replace(make_batch(5), ends_between_events=torch.ones(5, dtype=torch.bool))
    losses = model.get_loss_dict(model(make_rays(15, with_times=True)), batch)
    for name in ("interlevel_loss", "reconstruction_loss"):
        (gradient,) = torch.autograd.grad(losses[name], ratio, retain_graph=True, allow_unused=True)
        assert losses[name] > 0
        # All but rounding.
        assert gradient is None or abs(gradient) < 1e-5 * losses[name]


def test_the_starts_of_the_intervals_move_and_what_lies_within_keeps_its_place() -> None:
    model = make_learning_model().train()
    rays = make_rays(15, with_times=True)
    before = rays.times.clone()
    with torch.no_grad():
        model.supervision.raw_refractory_period.add_(0.7)
    period = model.supervision.refractory_period.item()
    outputs = model(rays)
    moved = rays.times - before
    torch.testing.assert_close(moved[:5], torch.full_like(moved[:5], period - 0.02), rtol=0, atol=1e-12)
    assert (moved[5:10] == 0).all()
    places = [(within - start) / (end - start) for start, end, within in (before.chunk(3), rays.times.chunk(3))]
    torch.testing.assert_close(places[0], places[1], rtol=1e-9, atol=1e-9)
    # Later starts make shorter intervals.
    assert outputs["interval_change"].item() == pytest.approx(0.02 - period, rel=1e-9)
    losses = model.get_loss_dict(outputs, replace(make_batch(5), last_interval=torch.full((5,), 0.1)))
    shorter = model.get_loss_dict(
        {k: v for k, v in outputs.items() if k != "interval_change"},
        replace(make_batch(5), last_interval=torch.full((5,), 0.1 + 0.02 - period)),
    )
    torch.testing.assert_close(losses["temporal_loss"], shorter["temporal_loss"])


@pytest.mark.parametrize("learned", [False, True])
def test_pairs_are_of_consecutive_events_where_the_refractory_period_is_learned(
    learned: bool, random_poses: torch.Tensor
) -> None:
    sampler = make_sampler(random_poses, SensorModel(), max_events_per_pair=3, learn_refractory_period=learned)
    _, batch = sampler.sample(400)
    assert (batch.num_positive + batch.num_negative == 1).all() == learned
