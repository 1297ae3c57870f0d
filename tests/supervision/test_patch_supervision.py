"""PAEv3D's patches and losses, by hand and by what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.small_models import EPOCH, GAP, KNOTS, make_supervision, make_window_sampler, pixels_of
from helpers.streams import make_stream
from nerfstudio.cameras.rays import RayBundle

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventStream
from aenerf_ns.supervision.peers.paev3d import (
    FlowPatchSampler,
    PAEv3DSupervision,
    PatchBatch,
    change_by_flow,
    depth_loss,
    mask_loss,
)
from aenerf_ns.supervision.peers.windows import WindowSamplerConfig

WIDTH, HEIGHT = 9, 7
CAMERA = CameraIntrinsics(WIDTH, HEIGHT, 9.0, 9.0, 4.5, 3.5, "radial_tangential", (0.0, 0.0, 0.0, 0.0, 0.0))
ALL = torch.ones(3, dtype=torch.bool)


def test_the_mask_loss_by_hand() -> None:
    opacity = torch.tensor([0.5, 0.9, 0.2])
    assert mask_loss(opacity, ALL).item() == pytest.approx(0.399254, abs=1e-6)
    assert mask_loss(opacity, torch.tensor([False, True, True])).item() == pytest.approx(-np.log(0.9))
    assert mask_loss(opacity, ~ALL).item() == 0


def test_the_depth_loss_by_hand() -> None:
    depth, speed = torch.tensor([2.0, 4.0, 1.0]), torch.tensor([3.0, 1.0, 4.0])
    one = torch.zeros(3, dtype=torch.long)
    assert depth_loss(depth, torch.ones(3), speed, one).item() == pytest.approx(0.083333, abs=1e-6)
    # What is transparent or has no flow neither counts nor sets the maximum.
    more = [torch.cat([values, torch.tensor(others)]) for values, others in ((depth, [0.1, 0.1]), (speed, [9.0, 0.0]))]
    opacity = torch.tensor([1.0, 1.0, 1.0, 0.2, 1.0])
    assert depth_loss(more[0], opacity, more[1], torch.zeros(5, dtype=torch.long)).item() == pytest.approx(1 / 12)
    # A window in which everything is ten times as fast changes nothing.
    twice = depth_loss(depth.repeat(2), torch.ones(6), torch.cat([speed, 10 * speed]), one.repeat(2) + ALL.repeat(2))
    both = depth_loss(depth.repeat(2), torch.ones(6), torch.cat([speed, 10 * speed]), torch.tensor([0, 0, 0, 1, 1, 1]))
    assert both.item() == pytest.approx(1 / 12)
    assert twice.item() > 0.2
    assert depth_loss(depth, torch.zeros(3), speed, one).item() == 0


def test_the_change_by_flow_by_hand() -> None:
    values = 255 * torch.tensor([[[0.1, 0.2], [0.1, 0.3]]])[..., None]
    along_x = torch.tensor([1.0, 0.0]).expand(1, 2, 2, 2)
    expected = torch.tensor([[[-25.5, -25.5], [-51.0, -51.0]]])
    torch.testing.assert_close(change_by_flow(values, along_x)[..., 0], expected)
    along_y = torch.tensor([0.0, 2.0]).expand(1, 2, 2, 2)
    torch.testing.assert_close(change_by_flow(values, along_y)[..., 0], torch.tensor([[[0.0, -51.0], [0.0, -51.0]]]))
    # Each channel by itself.
    both = change_by_flow(torch.cat([values, 2 * values], -1), along_y)
    torch.testing.assert_close(both[..., 1], 2 * both[..., 0])


class Samples:
    """The part of ray samples that the expected depth needs."""

    def __init__(self, middles: torch.Tensor) -> None:
        self.frustums = self
        self.starts = self.ends = middles[..., None]

    def __getitem__(self, index: slice) -> Samples:
        return Samples(self.starts[index][..., 0])


def losses_of(
    predicted: torch.Tensor, net: list[float], threshold: float, training: bool = False, **batch: torch.Tensor
) -> dict[str, torch.Tensor]:
    supervision = make_supervision(PAEv3DSupervision, SensorModel(threshold, threshold))
    supervision.train(training)
    count = len(predicted)
    weights = batch.pop("weights", torch.full((count, 1), 0.5))
    start = batch.pop("start", torch.zeros(count))
    outputs = {
        "log_radiance": torch.cat([start, start + predicted])[:, None],
        "weights_list": [torch.cat([weights, weights])[..., None]],
        "ray_samples_list": [Samples(torch.ones(2 * count, weights.shape[1]) * torch.arange(1, weights.shape[1] + 1))],
    }
    counts = torch.tensor(net)
    channel = torch.zeros(count, dtype=torch.long)
    parts = {"window": channel, "displacement": torch.zeros(count, 2)} | batch
    return supervision.losses(outputs, PatchBatch(counts.clamp_min(0), (-counts).clamp_min(0), channel, **parts))


def test_changes_are_compared_by_their_absolute_error_and_cut_at_five_events() -> None:
    start, end = (torch.tensor(values, dtype=torch.float64) + 1e-6 for values in ([0.5, 0.4], [0.6, 0.4]))
    losses = losses_of((end / start).log(), [1.0, -7.0], 0.1)
    # The release's is not in units of the threshold.
    assert losses.keys() == {"reconstruction_loss"}
    assert losses["reconstruction_loss"].item() == pytest.approx(0.291161 / 0.1, rel=1e-5)


def test_priors_are_of_the_starts_of_windows_and_in_units_of_the_threshold() -> None:
    start = torch.tensor([0.1, 0.2, 0.1, 0.3])
    displacement = torch.tensor([[1.0, 0.0], [0.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    losses = losses_of(
        torch.zeros(4),
        [0.0, 0.0, -1.0, 0.0],
        0.2,
        training=True,
        start=start,
        # Opaque at the distance 2, at 1 to a half, transparent, and opaque at 1.
        weights=torch.tensor([[0.0, 1.0], [0.5, 0.0], [0.1, 0.0], [1.0, 0.0]]),
        displacement=displacement,
        window=torch.zeros(4, dtype=torch.long),
    )
    assert losses["reconstruction_loss"].item() == pytest.approx(0.2 / 4 / 0.2)
    assert losses["mask_loss"].item() == pytest.approx(0, abs=1e-6)
    assert losses["depth_loss"].item() == pytest.approx((1 / 2 - 1 / 4) / 2 / 0.2)
    by_flow = [-0.1, 0.0, -0.6, -0.8]
    assert losses["flow_loss"].item() == pytest.approx(np.abs(np.array(by_flow) - [0, 0, -0.2, 0]).mean() / 0.2)


def test_gradients_are_finite_where_nothing_is_opaque_and_nothing_moves() -> None:
    predicted = torch.zeros(4, requires_grad=True)
    weights = torch.zeros(4, 2, requires_grad=True)
    nothing = {"displacement": torch.zeros(4, 2), "window": torch.zeros(4, dtype=torch.long)}
    losses = losses_of(predicted, [0.0] * 4, 0.2, training=True, weights=weights, **nothing)
    for gradient in torch.autograd.grad(sum(losses.values()), [predicted, weights], allow_unused=True):
        assert gradient is None or gradient.isfinite().all()


def make_events() -> EventStream:
    """One event a pixel in each interval between poses, in patches with 0 to 4 active pixels, and two that cancel."""
    rng = np.random.default_rng(0)
    rows = []
    for knot in KNOTS[:-1]:
        for row in range(HEIGHT // 2):
            for column in range(WIDTH // 2):
                for pixel in range((row * 4 + column) % 5):
                    time = int(knot + rng.integers(1, 200_000_000))
                    rows.append((2 * column + pixel % 2, 2 * row + pixel // 2, time, 1))
        rows += [(1, 1, int(knot) + 10, sign) for sign in (1, -1)]
    return make_stream(sorted(rows, key=lambda row: row[2]), WIDTH, HEIGHT)


def make_sampler(
    random_poses: torch.Tensor, camera: CameraIntrinsics = CAMERA, events: EventStream | None = None, **options: Any
) -> FlowPatchSampler:
    config = WindowSamplerConfig(_target=FlowPatchSampler, **{"longest_window": 0.0, **options})
    return make_window_sampler(config, PAEv3DSupervision, events or make_events(), int(KNOTS[-1]), random_poses, camera)


def patches_of(rays: RayBundle) -> np.ndarray:
    """The (patches, 4, 2) rows and columns of the pixels of a batch."""
    return np.stack(np.divmod(pixels_of(rays[: len(rays) // 2], CAMERA), WIDTH), -1).reshape(-1, 4, 2)


def test_patches_are_drawn_by_their_number_of_active_pixels(random_poses: torch.Tensor) -> None:
    sampler = make_sampler(random_poses)
    rays, batch = sampler.sample(8 * 1024)
    patches = patches_of(rays)
    corner = patches[:, 0]
    assert (corner % 2 == 0).all()
    assert (patches - corner[:, None] == [[0, 0], [0, 1], [1, 0], [1, 1]]).all()
    # All of the image but its last row and column, which make no patch.
    assert len(np.unique(corner, axis=0)) == (HEIGHT // 2) * (WIDTH // 2)
    active = (batch.num_positive != batch.num_negative).reshape(-1, 4).sum(1)
    assert active.bincount().tolist() == [20, 100, 100, 100, 704]
    # Four windows of as many patches each.
    assert batch.window.bincount().tolist() == [1024] * 4
    assert len(sampler.sample(1)[0]) == 8
    assert len(sampler.sample(75)[0]) == 72


def test_patches_of_any_number_take_the_place_of_those_that_no_window_has(random_poses: torch.Tensor) -> None:
    silent = make_events()
    sampler = make_sampler(random_poses, events=silent[silent.t <= KNOTS[0] + 10])
    _, batch = sampler.sample(8 * 64)
    assert len(batch) == 256


def test_displacements_are_those_of_the_flow_and_are_zero_where_nothing_happens(
    random_poses: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told_apart(events: EventStream) -> tuple[np.ndarray, int]:
        """A flow that tells which events it is of."""
        tiles = np.arange(3 * 3 * 2.0).reshape(3, 3, 2)
        return tiles + np.array([len(events), (events.t.mean() - EPOCH) * 1e-7]), 4

    monkeypatch.setattr("aenerf_ns.events.optical_flow.optical_flow", told_apart)
    events = make_events()
    sampler = make_sampler(random_poses, pixels_per_window=64)
    rays, batch = sampler.sample(8 * 256)
    patches = patches_of(rays).reshape(-1, 2)
    starts, ends = (torch.round(rays.times[:, 0] / 0.2).long()).chunk(2)
    parts = [events.between(int(first), int(last)) for first, last in ((KNOTS[0], GAP[0]), (GAP[1], KNOTS[-1]))]
    size = 2 * WIDTH * HEIGHT
    for index, (row, column) in enumerate(patches):
        part = parts[int(starts[index] >= 4)]
        # The stretches of a part between gaps, of which the last one ends where the part ends.
        at = int(np.searchsorted(part.t, KNOTS[starts[index]]))
        begin = max(min(at // size * size, len(part) - size), 0)
        velocities, side = told_apart(part[begin : begin + size])
        silent = batch.num_positive[index] + batch.num_negative[index] == 0
        expected = 0.2 * (ends - starts)[index].item() * velocities[row // side, column // side] * (not silent)
        assert batch.displacement[index].numpy() == pytest.approx(expected, rel=1e-5), index


def test_poses_without_events_leave_the_flow_after_the_gap_as_it_is(
    random_poses: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aenerf_ns.events.optical_flow.optical_flow", lambda events: (np.array(len(events)), 4))
    events = make_events()
    sampler = make_sampler(random_poses, events=events[events.t > GAP[1]])
    assert sampler._flow(int(KNOTS[0]))[0] == 0
    assert sampler._flow(GAP[1])[0] > 0


def test_a_window_has_a_patch_at_least(random_poses: torch.Tensor) -> None:
    _, batch = make_sampler(random_poses, pixels_per_window=1).sample(8 * 5)
    assert batch.window.tolist() == np.repeat(np.arange(5), 4).tolist()


def test_a_camera_without_patches_is_refused(random_poses: torch.Tensor) -> None:
    blind = CameraIntrinsics(WIDTH, HEIGHT, 9.0, 9.0, 4.5, 3.5, "radial_tangential", (-9.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="it gives no patch of 2 x 2 pixels a direction"):
        make_sampler(random_poses, camera=blind)
