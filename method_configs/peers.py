"""``ns-train robust-enerf``, ``eventnerf``, ``evnerf``, ``paev3d`` and ``e2vid-nerf``: other papers' supervision.

Each is trained on AE-NeRF's field, on the poses as given, in the sizes of ``aenerf`` and of ``aenerf-small``.
"""

from __future__ import annotations

from copy import deepcopy

from nerfstudio.plugins.types import MethodSpecification

from aenerf_ns.method.pose_correction import PoseCorrectionConfig
from aenerf_ns.method_configs.aenerf import aenerf, small
from aenerf_ns.supervision.base import LossCoefficients, SamplerConfig, SupervisionConfig
from aenerf_ns.supervision.event_pairs import PairLossCoefficients, PairSamplerConfig, PairSupervisionConfig
from aenerf_ns.supervision.peers.frames import FrameSampler, FrameSupervision
from aenerf_ns.supervision.peers.paev3d import FlowPatchSampler, PAEv3DLossCoefficients, PAEv3DSupervision
from aenerf_ns.supervision.peers.windows import (
    EventNeRFSupervision,
    EvNeRFLossCoefficients,
    EvNeRFSupervision,
    WindowSamplerConfig,
)


def peer(
    name: str,
    title: str,
    what: str,
    sampler: SamplerConfig,
    supervision: SupervisionConfig,
    loss_coefficients: LossCoefficients,
) -> tuple[MethodSpecification, MethodSpecification]:
    """Return another paper's method, at full size for a GPU and small for a CPU.

    Args:
        name: of the method at full size; "-small" is appended for the other.
        title: of the method in a description.
        what: the rest of the description.
        sampler: how batches are drawn.
        supervision: how renderings are compared with them.
        loss_coefficients: weights of the losses.
    """
    config = deepcopy(aenerf.config)
    config.method_name = name
    config.pipeline.datamanager.sampler = sampler
    config.pipeline.model.supervision = supervision
    config.pipeline.model.loss_coefficients = loss_coefficients
    # Within 0.3 dB of the best for each of them, on two scenes with one seed (docs/defaults.md).
    config.pipeline.model.average_init_density = 1.0
    config.pipeline.model.camera_optimizer = PoseCorrectionConfig(mode="off")
    reduced = small(config)
    if isinstance(sampler, WindowSamplerConfig):
        # As many windows in a batch as at full size.
        reduced.pipeline.datamanager.sampler.pixels_per_window = 128
    return (
        MethodSpecification(config=config, description=f"{title}: {what}, on the poses as given."),
        MethodSpecification(config=reduced, description=f"{title}, small: for a CPU."),
    )


robust_enerf, robust_enerf_small = peer(
    "robust-enerf",
    "Robust e-NeRF's supervision",
    "pairs of consecutive events",
    PairSamplerConfig(max_events_per_pair=1, silent_pair_share=0.0),
    PairSupervisionConfig(allow_for_bandwidth=False),
    PairLossCoefficients(),
)
"""W. F. Low and G. H. Lee, ICCV 2023."""

eventnerf, eventnerf_small = peer(
    "eventnerf",
    "EventNeRF's supervision",
    "events summed over windows of random length",
    WindowSamplerConfig(),
    SupervisionConfig(_target=EventNeRFSupervision),
    LossCoefficients(),
)
"""V. Rudnev et al., CVPR 2023."""

evnerf, evnerf_small = peer(
    "evnerf",
    "Ev-NeRF's supervision",
    "slices of events, a dead zone and learned thresholds",
    WindowSamplerConfig(shortest_window=0.1, longest_window=0.1, share_of_all_pixels=1.0),
    SupervisionConfig(_target=EvNeRFSupervision),
    EvNeRFLossCoefficients(),
)
"""I. Hwang et al., WACV 2023."""

paev3d, paev3d_small = peer(
    "paev3d",
    "PAEv3D's supervision",
    "patches in windows, with priors from optical flow",
    WindowSamplerConfig(_target=FlowPatchSampler),
    SupervisionConfig(_target=PAEv3DSupervision),
    PAEv3DLossCoefficients(),
)
"""J. Wang et al., ICRA 2024."""

e2vid_nerf, e2vid_nerf_small = peer(
    "e2vid-nerf",
    "E2VID + NeRF",
    "trains on the images of aenerf reconstruct",
    SamplerConfig(_target=FrameSampler),
    SupervisionConfig(_target=FrameSupervision),
    LossCoefficients(),
)
"""H. Rebecq et al., PAMI 2021, with NeRF."""
