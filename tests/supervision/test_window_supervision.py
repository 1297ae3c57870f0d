"""Windows of time: what is drawn, and what EventNeRF and Ev-NeRF make of it."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from helpers.simulated_cuda import NEEDS_SIMULATION, Counts, SimulatedCuda, device
from helpers.small_models import CAMERA, EPOCH, GAP, KNOTS, make_rays, make_supervision, make_window_sampler, pixels_of
from helpers.streams import make_stream

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.metadata_keys import CAMERA_DIRECTIONS
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.supervision.base import ChangeBatch, ChangeSupervision, Supervision
from aenerf_ns.supervision.peers.windows import (
    EventNeRFSupervision,
    EvNeRFSupervision,
    WindowSampler,
    WindowSamplerConfig,
)
from aenerf_ns.supervision.pixel_rays import PixelRays

EVENTS = make_stream(
    [
        (x, y, EPOCH + t, p)
        for x, y, t, p in [
            (3, 1, 5_000, 1), (0, 2, 100_000_000, -1), (0, 2, 100_000_000, 1), (3, 1, 250_000_000, -1),
            (3, 1, 400_000_000, 1), (0, 2, 600_000_000, -1), (3, 1, 700_000_000, 1), (3, 1, 1_000_000_000, 1),
            (3, 1, 1_000_000_000, 1), (1, 1, 1_300_000_000, -1),
        ]
    ]
)  # fmt: skip


def make_sampler(
    random_poses: torch.Tensor, sensor: SensorModel | None = None, camera: CameraIntrinsics = CAMERA, **options: Any
) -> WindowSampler:
    config, end = WindowSamplerConfig(**options), int(KNOTS[-1]) - 50_000_000
    return make_window_sampler(config, EventNeRFSupervision, EVENTS, end, random_poses, camera, sensor)


def windows_of(rays: Any) -> list[tuple[int, int]]:
    """The two times of each pixel's window, in steps of a quarter of the poses' interval."""
    starts, ends = torch.round(rays.times[:, 0] / 0.05).long().chunk(2)
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def test_a_pixel_has_the_events_of_its_window_and_rays_at_both_ends(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, SensorModel(bayer_pattern="RGGB"), longest_window=1.0, pixels_per_window=3)
    rays, batch = sampler.sample(2400)
    assert rays.origins.shape == (2400, 3)
    pixels = pixels_of(rays)
    assert pixels[:1200] == pixels[1200:]
    seconds = np.round((rays.times[:, 0] * 1e9).numpy()).astype(np.int64) + EPOCH
    for index, (pixel, start, end) in enumerate(zip(pixels[:1200], seconds[:1200], seconds[1200:], strict=True)):
        y, x = divmod(pixel, 4)
        inside = (EVENTS.x == x) & (EVENTS.y == y) & (start < EVENTS.t) & (EVENTS.t <= end)
        inside &= (EVENTS.t <= GAP[0]) | (EVENTS.t >= GAP[1])
        assert batch.num_positive[index] == (EVENTS.p[inside] > 0).sum()
        assert batch.num_negative[index] == (EVENTS.p[inside] < 0).sum()
        assert batch.channel[index] == [[0, 1], [1, 2]][y % 2][x % 2]


def test_windows_end_at_poses_cross_no_gap_and_have_all_lengths_alike(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, longest_window=1.0, pixels_per_window=1)
    found = Counter(windows_of(sampler.sample(12_000)[0]))
    # Three intervals before the gap, three after it; the last ends where the events' time window does.
    steps = ([0, 4, 8, 12], [16, 20, 24, 27])
    expected = {}
    for edges in steps:
        for end in (1, 2, 3):
            for start in range(end):
                expected[edges[start], edges[end]] = 1 / 6 / end
    assert found.keys() == expected.keys()
    for window, share in expected.items():
        assert found[window] / 6000 == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize(("shortest", "longest", "lengths"), [(0.0, 0.0, {1}), (0.0, 0.34, {1, 2}), (0.3, 0.3, {2})])
def test_windows_are_as_long_as_asked_for(
    random_poses: torch.Tensor, shortest: float, longest: float, lengths: set[int]
) -> None:
    sampler = make_sampler(random_poses, shortest_window=shortest, longest_window=longest, pixels_per_window=1)
    windows = windows_of(sampler.sample(4000)[0])
    found = {(-(-(end - start) // 4), end in (4, 20)) for start, end in windows}
    # A window that ends at the first pose after a start has no place for more than one interval.
    assert found == {(length, False) for length in lengths} | {(1, True)}


def test_most_pixels_are_active_and_the_others_any_that_the_lens_sees(random_poses: torch.Tensor) -> None:
    # Of the pixels with events only (3, 1) has a direction.
    camera = CameraIntrinsics(4, 3, 1.0, 1.0, 3.0, 1.5, "radial_tangential", (-0.1, 0.0, 0.0, 0.0, 0.0))
    _, usable = camera.pixel_directions()
    assert usable[1].tolist() == [False, False, True, True]
    sampler = make_sampler(random_poses, camera=camera, longest_window=0.0, share_of_all_pixels=0.25)
    seen = set()
    for _ in range(40):
        rays, batch = sampler.sample(800)
        ((start, end),) = set(windows_of(rays))
        seen.add((start, end))
        sums = batch.num_positive - batch.num_negative
        directions = rays.metadata[CAMERA_DIRECTIONS][:400]
        # Two events that cancel make no pixel active, and an event at the start is not in the window.
        if (start, end) in ((0, 4), (16, 20)):
            assert (sums[:300] != 0).all()
            directions = directions[300:]
        else:
            assert (sums == 0).all()
        assert len(directions.unique(dim=0)) == usable.sum()
    assert len(seen) == 6


def test_a_batch_has_as_many_windows_as_fill_it(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, longest_window=1.0, pixels_per_window=10)
    rays, _ = sampler.sample(75)
    assert len(rays) == 74
    windows = windows_of(rays)
    assert [len(set(windows[part])) for part in (slice(0, 10), slice(10, 19), slice(19, 28), slice(28, 37))] == [1] * 4
    assert len(set(windows)) > 1
    assert len(sampler.sample(1, training=False)[0]) == 2


@NEEDS_SIMULATION
def test_a_batch_goes_to_the_device_in_one_copy(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses, pixels_per_window=5)
    with SimulatedCuda() as gpu:
        sampler.device = device()
        sampler.pixel_rays = PixelRays(sampler.dataset.scene, device())
        gpu.counts = Counts()
        rays, batch = sampler.sample(40)
    assert {value.device for value in (rays.times, rays.directions, *vars(batch).values())} == {device()}
    assert (gpu.counts.uploads, gpu.counts.downloads, gpu.counts.waits) == (1, 0, 0)


def test_sampling_is_seeded(random_poses: torch.Tensor) -> None:
    sampler, batches = make_sampler(random_poses, longest_window=1.0, pixels_per_window=4), []
    for _ in range(2):
        torch.manual_seed(3)
        batches.append(sampler.sample(80)[0])
    assert torch.equal(batches[0].times, batches[1].times)
    assert torch.equal(batches[0].directions, batches[1].directions)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"longest_window": 1.5}, "longest-window is 1.5; give a number from 0 to 1"),
        ({"share_of_all_pixels": -0.1}, "share-of-all-pixels is -0.1; give"),
        ({"shortest_window": 0.2}, "shortest-window is 0.2, longest-window 0.1; give"),
        ({"pixels_per_window": 0}, "pixels-per-window is 0; give at least 1"),
    ],
)
def test_options_out_of_range_are_refused(random_poses: torch.Tensor, options: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        make_sampler(random_poses, **options)


def test_poses_with_gaps_alone_are_refused(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses)
    at_poses = make_stream([(0, 0, int(time), 1) for time in KNOTS[:2]])
    window = TimeWindow(int(KNOTS[0]), int(KNOTS[1]), ((int(KNOTS[0]), int(KNOTS[1])),))
    sampler.dataset.windows = sort_events([at_poses], window=window, usable=np.ones((3, 4), bool))
    with pytest.raises(DataError, match="the poses: no two of them follow each other without a gap; give --max-pose"):
        sampler.prepare()


def compare(
    supervision: ChangeSupervision, predicted: torch.Tensor, positive: list[float], negative: list[float]
) -> dict[str, torch.Tensor]:
    """The losses for rendered changes of a gray sensor's pixels."""
    outputs = {"log_radiance": torch.cat([torch.zeros_like(predicted), predicted])[:, None]}
    outputs |= supervision.shift_ray_times(make_rays(2 * len(predicted), with_times=True))
    channel = torch.zeros(len(predicted), dtype=torch.long)
    return supervision.losses(outputs, ChangeBatch(torch.tensor(positive), torch.tensor(negative), channel))


def log_change(start: list[float], end: list[float], epsilon: float) -> torch.Tensor:
    """The change of EventNeRF's log-radiance between display values."""
    before, after = (torch.tensor(values, dtype=torch.float64) ** 2.2 + epsilon for values in (start, end))
    return (after / before).log()


@pytest.mark.parametrize(
    ("start", "end", "net", "epsilon", "expected"),
    [
        # The release divides by the three channels of each pixel, of which a mosaic's pixel sees one.
        ([0.5, 0.8], [0.6, 0.4], [1.0, -3.0], 0.1, 3 * 0.0226387),
        ([0.5, 0.8], [0.6, 0.4], [1.0, -3.0], 1e-5, 3 * 0.1038741),
        ([0.5], [0.6], [0.0], 0.1, 0.0848352),
    ],
)
def test_the_loss_of_eventnerf_is_the_releases_in_units_of_the_threshold(
    start: list[float], end: list[float], net: list[float], epsilon: float, expected: float
) -> None:
    supervision = make_supervision(EventNeRFSupervision, SensorModel(0.25, 0.25))
    counts = [max(n, 0.0) for n in net], [max(-n, 0.0) for n in net]
    (loss,) = compare(supervision, log_change(start, end, epsilon), *counts).values()
    assert loss.item() == pytest.approx(expected / 0.25**2, rel=1e-5)


@pytest.mark.parametrize(
    ("predicted", "positive", "negative", "excess"),
    [
        ([0.9, 0.1, -0.5, 0.2], [1, 0, 0, 0], [0, 0, 1, 0], [0.3, 0, 0, 0]),
        ([-0.4, 0.4, 1.0], [0, 0, 2], [0, 0, 1], [0.15, 0.10, 0.35]),
    ],
)
def test_the_loss_of_evnerf_by_hand(
    predicted: list[float], positive: list[float], negative: list[float], excess: list[float]
) -> None:
    supervision = make_supervision(EvNeRFSupervision, SensorModel(0.3, 0.25))
    losses = compare(supervision, torch.tensor(predicted), positive, negative)
    assert losses["reconstruction_loss"].item() == pytest.approx(np.mean(excess) / 0.275, rel=1e-5)
    assert losses["threshold_bound_loss"].item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("learned", "expected"), [((0.2, 0.25), 0.15), ((0.35, 0.4), 0.0)])
def test_the_bound_holds_thresholds_at_the_sensors(learned: tuple[float, float], expected: float) -> None:
    supervision = make_supervision(EvNeRFSupervision, SensorModel(0.3, 0.3))
    factors = torch.tensor(learned) / 0.3
    supervision.raw_factors.data = factors.expm1().log()
    assert supervision.learned_values() == pytest.approx(
        {"positive_threshold": learned[0], "negative_threshold": learned[1]}
    )
    losses = compare(supervision, torch.zeros(1), [0.0], [0.0])
    assert losses["threshold_bound_loss"].item() == pytest.approx(expected / 0.3, rel=1e-5)
    # The unit stays the sensor's.
    assert supervision.loss_unit({}) == pytest.approx(0.3)


def test_learned_thresholds_have_gradients_from_both_losses() -> None:
    supervision = make_supervision(EvNeRFSupervision, SensorModel(0.3, 0.25))
    supervision.raw_factors.data -= 0.1
    # Outside at the upper edge with two positive events, outside at the lower edge with three negative ones.
    losses = compare(supervision, torch.tensor([1.5, -0.2]), [2.0, 0.0], [0.0, 3.0])
    for name, signs in (("reconstruction_loss", [-1, 1]), ("threshold_bound_loss", [-1, -1])):
        (gradient,) = torch.autograd.grad(losses[name], supervision.raw_factors, retain_graph=True)
        assert gradient.sign().tolist() == signs, name


@pytest.mark.parametrize("kind", [EventNeRFSupervision, EvNeRFSupervision])
def test_gradients_are_finite_where_events_cancel_or_come_in_crowds(kind: type[Supervision]) -> None:
    supervision = make_supervision(kind, SensorModel(0.3, 0.25))
    predicted = torch.tensor([0.0, 0.0, 40.0, -0.25], requires_grad=True)
    losses = compare(supervision, predicted, [0.0, 3.0, 1000.0, 0.0], [0.0, 3.0, 0.0, 1.0])
    inputs = [predicted, *supervision.parameters()]
    gradients = torch.autograd.grad(sum(losses.values()), inputs, allow_unused=True)
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    # A single pixel, as in the smallest batch.
    assert all(loss.isfinite() for loss in compare(supervision, predicted[:1], [1.0], [0.0]).values())
