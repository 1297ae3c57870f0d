"""Small samplers, models and batches."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from aenerf_ns.camera.alignment import Similarity
from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.metadata_keys import CAMERA_DIRECTIONS
from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.pairing import pair_events
from aenerf_ns.events.polarity_drift import PolarityDrift, polarity_drift
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.sorted_events import sort_events
from aenerf_ns.events.stream import EventStream
from aenerf_ns.method.model import AENeRFModel, AENeRFModelConfig
from aenerf_ns.method.networks import FieldConfig, ProposalConfig
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig
from aenerf_ns.recording.scene import SCENE_KEY, SceneRecording
from aenerf_ns.supervision.base import LossCoefficients, SamplerConfig, Supervision, SupervisionConfig
from aenerf_ns.supervision.event_pairs import (
    PairBatch,
    PairLossCoefficients,
    PairSampler,
    PairSamplerConfig,
    PairSupervisionConfig,
)
from helpers.streams import EventsInMemory, make_stream

CAMERA = CameraIntrinsics(4, 3, 5.0, 5.0, 2.0, 1.5, "radial_tangential", (-0.1, 0.0, 0.002, 0.0, 0.0))


ALL_LOSSES = PairLossCoefficients(temporal_loss=1e-3)
EPOCH = 1_600_000_000_000_000_000
# Poses every 0.2 s; the middle interval is a gap.
KNOTS = EPOCH + 200_000_000 * np.arange(8)
GAP = (int(KNOTS[3]), int(KNOTS[4]))


def make_scene(
    sensor: SensorModel, trajectory: Trajectory, camera: CameraIntrinsics = CAMERA, bounded: bool = False
) -> SceneRecording:
    return SceneRecording(
        frame=Similarity(torch.ones(()), torch.eye(3), torch.zeros(3)),
        trajectory=trajectory,
        ground_truth=None,
        event_camera=camera,
        event_file=EventsInMemory(make_stream([], camera.width, camera.height)),
        sensor=sensor,
        window=TimeWindow(),
        camera=camera,
        camera_times=torch.tensor([0]),
        has_image=[False],
        image_encoding="srgb",
        bounded=bounded,
    )


def make_supervision(kind: type[Supervision], sensor: SensorModel | None = None) -> Any:
    """Another paper's supervision, with the usual weights."""
    return SupervisionConfig(_target=kind).setup(sensor=sensor or SensorModel(), loss_coefficients=LossCoefficients())


def make_window_sampler(
    config: SamplerConfig,
    supervision: type[Supervision],
    events: EventStream,
    end: int,
    poses: torch.Tensor,
    camera: CameraIntrinsics,
    sensor: SensorModel | None = None,
) -> Any:
    """A sampler of windows of the time from the first pose to an end, without the gap."""
    sensor = sensor or SensorModel()
    window = TimeWindow(int(KNOTS[0]), end, (GAP,))
    scene = replace(make_scene(sensor, Trajectory(KNOTS, poses), camera), window=window)
    windows = sort_events([events], window=window, usable=camera.pixel_directions()[1])
    dataset = SimpleNamespace(scene=scene, windows=windows)
    return config.setup(dataset=dataset, supervision=make_supervision(supervision, sensor), device="cpu")


def pixels_of(rays: RayBundle, camera: CameraIntrinsics = CAMERA) -> list[int]:
    """The number of the pixel that each ray leaves."""
    directions = camera.pixel_directions()[0].reshape(-1, 3)
    return [int(np.abs(directions - ray).sum(1).argmin()) for ray in rays.metadata[CAMERA_DIRECTIONS].numpy()]


def make_sampler(
    random_poses: torch.Tensor,
    sensor: SensorModel,
    camera: CameraIntrinsics = CAMERA,
    max_events_per_pair: int = 1,
    share: float = 0.0,
    temporal: bool = False,
    learn_refractory_period: bool = False,
    drift: PolarityDrift | None = None,
    stream: EventStream | None = None,
) -> PairSampler:
    """A sampler of a stream, by default five events at two pixels."""
    rows = [(3, 1, 5_000, 1), (0, 2, 100_000, -1), (3, 1, 250_000_000, -1), (0, 2, 600_000_000, -1), (3, 1, 10**9, 1)]
    stream = stream or make_stream([(x, y, EPOCH + t, p) for x, y, t, p in rows])
    _, usable = camera.pixel_directions()
    pairs = pair_events([stream], refractory_period=sensor.refractory_period, usable=usable)
    trajectory = Trajectory(KNOTS, random_poses)
    scene, drift = make_scene(sensor, trajectory, camera), drift or polarity_drift(pairs)
    return PairSamplerConfig(max_events_per_pair=max_events_per_pair, silent_pair_share=share).setup(
        dataset=SimpleNamespace(scene=scene, pairs=pairs, polarity_drift=drift),
        supervision=PairSupervisionConfig(learn_refractory_period=learn_refractory_period).setup(
            sensor=sensor, loss_coefficients=PairLossCoefficients(temporal_loss=float(temporal))
        ),
        device="cpu",
    )


def make_correction(trajectory: Trajectory, ground_truth: Trajectory | None = None, **options: Any) -> PoseCorrection:
    """A correction that has learned nothing yet, with cameras at the first three poses."""
    times = trajectory.times[:3]
    return PoseCorrectionConfig(**options).setup(
        num_cameras=len(times), device="cpu", trajectory=trajectory, camera_times=times, ground_truth=ground_truth
    )


SMALL_FIELD = {
    "num_samples_per_ray": 12, "num_levels": 4, "max_resolution": 32, "log2_hashmap_size": 10, "hidden_dim": 16
}  # fmt: skip
SMALL_PROPOSAL = {"num_samples_per_ray": (16,), "max_resolutions": (16,), "num_levels": 2, "log2_hashmap_size": 8}


def make_model(
    sensor: SensorModel | None = None,
    bounded: bool = False,
    trajectory: Trajectory | None = None,
    field: dict[str, Any] | None = None,
    proposal: dict[str, Any] | None = None,
    **options: Any,
) -> AENeRFModel:
    torch.manual_seed(0)
    config = AENeRFModelConfig(
        field=FieldConfig(**{**SMALL_FIELD, **(field or {})}),
        proposal=ProposalConfig(**{**SMALL_PROPOSAL, **(proposal or {})}),
        **options,
    )
    ends = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    ends[:, 2, 3] = 3
    ends[:, 0, 3] = torch.tensor([-0.3, 0.3])
    ends[1, :3, :3] = rotation_from_vector(torch.tensor([0.03, -0.06, 0.1], dtype=torch.float64))
    scene = make_scene(sensor or SensorModel(0.2, 0.3), trajectory or Trajectory([0, 10**9], ends), bounded=bounded)
    box = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    return config.setup(scene_box=box, num_train_data=1, metadata={SCENE_KEY: scene})


def make_rays(count: int = 10, away: bool = False, with_times: bool = False) -> RayBundle:
    """Rays from z = 3 towards the scene box, or past it."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.tensor([0.0, 0.0, 1.0 if away else -1.0]) + 0.1 * torch.randn(count, 3, generator=generator)
    directions = F.normalize(directions, dim=-1)
    return RayBundle(
        origins=torch.tensor([0.0, 0.0, 3.0]).expand(count, 3),
        directions=directions,
        pixel_area=torch.ones(count, 1),
        camera_indices=torch.zeros(count, 1, dtype=torch.long),
        times=torch.rand(count, 1, generator=generator, dtype=torch.float64) if with_times else None,
        metadata={"camera_directions": directions.double()} if with_times else {},
    )


def make_batch(num_pairs: int) -> PairBatch:
    positive = (torch.arange(num_pairs) % 2).float()
    zeros = torch.zeros_like(positive).long()
    return PairBatch(
        num_positive=positive,
        num_negative=1 - positive,
        channel=zeros,
        ends_between_events=zeros.bool(),
        last_num_positive=positive,
        last_num_negative=1 - positive,
        last_interval=torch.full_like(positive, 1e-3),
        pixel=zeros,
        drift=torch.zeros_like(positive),
        weight=torch.ones_like(positive),
        start_rate=torch.zeros_like(positive),
        end_rate=torch.zeros_like(positive),
    )
