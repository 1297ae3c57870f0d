"""ψ: corrections of the estimated trajectory in continuous time, as Nerfstudio's camera optimizer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.encodings import NeRFEncoding
from torch import Tensor, nn

from aenerf_ns.camera.alignment import Similarity, align_most, rotation_angle
from aenerf_ns.camera.metadata_keys import CAMERA_DIRECTIONS, REFERENCE_SECONDS, TRAJECTORY_SECONDS
from aenerf_ns.camera.rotation import TwistExponential
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.errors import DataError

# Poses at which trajectories are compared: enough for any metric, few enough to be logged quickly.
_MAX_COMPARED = 2000
# A step of the optimizer changes hundreds of weights behind each number of a network's twist, but few behind a number
# of a spline's. With this factor on the network's output, both move about as far at one learning rate.
_NETWORK_OUTPUT_SCALE = 2e-3
# Errors of poses that come one by one, as from frames, change from pose to pose. Where poses are further than this from
# the motion through their neighbors, in radians and extents, a finer spline is added, with so many times closer knots.
_JITTER, _FINER = 1e-3, 4
# Poses that the network takes at once where nothing is learned. It takes some 50 kB of memory for each.
_CHUNK = 2000
_MIN_EXTENT = 1e-6
_MIN_SPEED = 1e-6
# Seconds by which a learned clock offset may differ from the value it begins with. Larger errors smear the field so far
# that it does not lead back.
_MAX_CLOCK_CHANGE = 0.05


@dataclass
class PoseCorrectionConfig(CameraOptimizerConfig):
    """Correction of the estimated poses along the trajectory."""

    _target: type = field(default_factory=lambda: PoseCorrection)
    mode: Literal["off", "network", "spline"] = "off"
    """How corrections vary in time: by the paper's network, by a cubic B-spline of twists, or not at all."""
    trans_l2_penalty: float = 1.0
    """Weight of the mean squared translation of the corrections, in units of the trajectory's extent."""
    rot_l2_penalty: float = 1.0
    """Weight of the mean squared rotation of the corrections, in radians."""
    knot_interval: float = 0.1
    """Seconds between the knots of the spline. It corrects errors that change more slowly than that. Where the given
    poses jitter, a spline with a quarter of it is added, which learns later and more slowly."""
    rigid_offset: bool = False
    """Learn one rigid motion from the given poses to the camera's, the same at all times: the error of a hand-eye
    calibration. It works with every mode."""
    clock_offset: float | None = None
    """Learn by how many seconds the clock of the poses is ahead of the clock of the events, beginning with this value
    and changing it by at most 0.05 s. aenerf check finds a value to begin with. Events that the offset moves beyond the
    ends of the trajectory see the pose of the end. It works with every mode. None: the clocks agree."""


class PoseCorrection(CameraOptimizer):
    """Corrects the pose at every time t to base pose(t + δ) · exp(ξ(t)) · exp(χ), with a twist ξ (paper, eq. 6).

    The clock offset δ and the rigid offset χ do not depend on time. They are not in the paper, and zero unless the
    configuration asks for them. Times t + δ beyond the ends of the trajectory get the pose of the end.

    ξ is zero before training, but its gradients are not. Network and spline count rotation in radians and translation
    in units of the trajectory's extent (root mean square distance from its middle). So a learning rate means the same
    for a camera that moves by centimeters and for a camera that is carried through a hall.

    The scene is reconstructed in the frame of the corrected poses. Reference images have poses in the frame of the true
    trajectory or, where the true trajectory is not known, of the estimated one. :meth:`apply_to_camera` carries the
    cameras of reference images over.

    Args:
        config: the kind of correction and its penalties.
        num_cameras: training cameras.
        device: of the parameters.
        trajectory: the estimated trajectory, camera-to-world, OpenGL camera axes, in scene units.
        camera_times: (num_cameras,) times of the training cameras in nanoseconds, for :meth:`forward`.
        ground_truth: the true trajectory with the same conventions, or None. It never enters a loss.

    Attributes:
        translation_unit: the trajectory's extent, by which translations are counted, in scene units.
        span: (2,) times of the first and the last given pose in nanoseconds, where anything is learned.
    """

    config: PoseCorrectionConfig
    _true_poses: Tensor | None

    def __init__(
        self,
        config: PoseCorrectionConfig,
        num_cameras: int,
        device: torch.device | str,
        trajectory: Trajectory,
        camera_times: Tensor,
        ground_truth: Trajectory | None = None,
    ) -> None:
        # The framework's corrections, one for each camera, are off.
        super().__init__(CameraOptimizerConfig(mode="off"), num_cameras, device)
        self.config = config
        self.trajectory = trajectory
        self._camera_seconds: Tensor = nn.Buffer(trajectory.seconds(camera_times), persistent=False)
        times = _compared_times(trajectory, ground_truth)
        self.has_ground_truth = ground_truth is not None
        self._compared_seconds: Tensor = nn.Buffer(trajectory.seconds(times), persistent=False)
        true_poses = None if ground_truth is None else ground_truth.interpolate(times)
        self.register_buffer("_true_poses", true_poses, persistent=False)
        # A camera that only turns gives translations no unit. The unit of the scene serves instead.
        self.translation_unit = extent = trajectory.extent if trajectory.extent > _MIN_EXTENT else 1.0
        # Times in every interval of the spline, at which the size of the corrections is taken.
        count = max(64, math.ceil(trajectory.duration / config.knot_interval))
        sampled = torch.linspace(0, trajectory.duration, count, dtype=torch.float64)
        units, penalties = [extent] * 3 + [1.0] * 3, [config.trans_l2_penalty] * 3 + [config.rot_l2_penalty] * 3
        self._twist_units: Tensor = nn.Buffer(torch.tensor(units, dtype=torch.float64), persistent=False)
        self._penalties: Tensor = nn.Buffer(torch.tensor(penalties, dtype=torch.float64), persistent=False)
        self._sampled_seconds: Tensor = nn.Buffer(sampled, persistent=False)
        self._sampled_poses: Tensor = nn.Buffer(trajectory.pose(sampled), persistent=False)
        self._exponential = TwistExponential()
        self.training_cameras_are_corrected = False
        self.rigid_offset = nn.Parameter(torch.zeros(6)) if config.rigid_offset else None
        self.clock_change: nn.Parameter | None = None
        if config.clock_offset is not None:
            self.clock_change = nn.Parameter(torch.zeros(()))
            self.clock_start: Tensor = nn.Buffer(torch.tensor(config.clock_offset, dtype=torch.float64))
            # The seconds in which the camera moves by a unit of the twists: a step of the optimizer then moves poses
            # about as far by the clock as by a twist.
            _, rate = trajectory.pose_and_rate(sampled)
            turning, moving = rate[..., :3].square().sum((1, 2)) / 2, (rate[..., 3] / extent).square().sum(-1)
            self._clock_unit = 1 / max(float((turning + moving).mean().sqrt()), _MIN_SPEED)
        self.twists: TwistNetwork | TwistSpline | None = None
        if config.mode == "network":
            self.twists = TwistNetwork(trajectory)
        elif config.mode == "spline":
            jitters = _jitter(trajectory, extent) > _JITTER
            self.twists = TwistSpline(trajectory.duration, config.knot_interval, with_finer=jitters)
        if self.is_learned:
            self.span: Tensor = nn.Buffer(torch.tensor([trajectory.start, trajectory.end]))

    @property
    def is_learned(self) -> bool:
        """Whether anything about the poses is learned."""
        return self.twists is not None or self.rigid_offset is not None or self.clock_change is not None

    def clock_offset(self) -> Tensor:
        """Return δ, the float64 seconds by which the clock of the poses is ahead of the clock of the events."""
        return (self.config.clock_offset or 0.0) + _MAX_CLOCK_CHANGE * self.clock_change_share()

    def clock_change_share(self) -> Tensor:
        """Return the learned change of the clock offset as a share of the largest one, between -1 and 1."""
        if self.clock_change is None:
            return self._sampled_seconds.new_zeros(())
        return torch.tanh(self.clock_change.double() * (self._clock_unit / _MAX_CLOCK_CHANGE))

    def pose(self, seconds: Tensor) -> Tensor:
        """Return corrected (N, 3, 4) float64 poses at (N,) float64 seconds since the trajectory's start."""
        base = pose = self.trajectory.pose(self.on_clock_of_poses(seconds))
        if self.twists is not None:
            pose = self._exponential(pose, self._twist_units * self.twists(seconds, base))
        if self.rigid_offset is not None:
            pose = self._exponential(pose, self._rigid_twists(len(pose)))
        return pose

    def pose_and_rate(self, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of :meth:`pose` and their derivatives with respect to time, per second."""
        base, base_rate = self.trajectory.pose_and_rate(self.on_clock_of_poses(seconds))
        if self.clock_change is not None:
            base_rate = torch.where(self._moves(seconds), base_rate, 0.0)
        pose, rate = base, base_rate
        if self.twists is not None:
            twist, twist_rate = (self._twist_units * part for part in self.twists.with_rate(seconds, base, base_rate))
            pose, rate = self._exponential.with_rate(pose, rate, twist, twist_rate)
        if self.rigid_offset is not None:
            # From the right, a constant motion acts on rates as on poses.
            both = self._exponential(torch.cat([pose, rate], -2), self._rigid_twists(len(pose)))
            pose, rate = both.split(3, -2)
        return pose, rate

    def on_clock_of_poses(self, seconds: Tensor, at_first: bool = False) -> Tensor:
        """Return the times on the trajectory at which base poses are looked up, now or at first, for events' times."""
        if self.config.clock_offset is None:
            return seconds
        offset = self.config.clock_offset if at_first else self.clock_offset()
        return (seconds + offset).clamp(0, self.trajectory.duration)

    def _moves(self, seconds: Tensor) -> Tensor:
        """Return which (N, 1, 1) cameras move with the clock: beyond its ends the trajectory stands still."""
        return (self.on_clock_of_poses(seconds) == seconds + self.clock_offset())[:, None, None]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # The learned change counts from the start value. Checkpoints of earlier versions hold neither it nor the span.
        if self.clock_change is not None:
            start = float(state_dict.setdefault(f"{prefix}clock_start", self.clock_start))
            if start != self.config.clock_offset:
                args[-1].append(f"it began with clock-offset {start:g}, not {self.config.clock_offset:g}")
        # Twists count their times from the start, so they would correct poses of other times. Offsets count in units of
        # the trajectory, so they would be others.
        if self.is_learned:
            learned, own = state_dict.setdefault(f"{prefix}span", self.span).tolist(), self.span.tolist()
            if learned != own:
                problem = "its poses are from {} to {} ns, and the corrections of poses from {} to {} ns"
                remedy = "give the poses and the time window of the run, or train again"
                raise DataError(self.trajectory.source, problem.format(*own, *learned), remedy)
        # Checkpoints of earlier versions hold no finer spline either. The framework's pipeline loads once more without
        # the model's part of a checkpoint, where zeros would replace the finer spline that was loaded.
        finer = self.twists.finer if isinstance(self.twists, TwistSpline) else None
        if finer is not None and f"{prefix}twists.control_twists" in state_dict:
            none = torch.zeros_like(finer.control_twists)
            state_dict.setdefault(f"{prefix}twists.finer.control_twists", none)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _rigid_twists(self, count: int) -> Tensor:
        """Return χ in scene units and radians, (count, 6) float64."""
        assert self.rigid_offset is not None
        return (self._twist_units * self.rigid_offset).expand(count, 6)

    def forward(self, indices: Tensor) -> Tensor:
        """Return (N, 3, 4) motions that the framework multiplies the training cameras' poses with.

        The motions are identities once ``training_cameras_are_corrected``.
        """
        if self.training_cameras_are_corrected:
            return torch.eye(4, device=indices.device)[:3].expand(len(indices), 3, 4)
        seconds = self._camera_seconds[indices]
        base = homogeneous(self.trajectory.pose(seconds))
        return (torch.linalg.inv(base) @ homogeneous(self.pose(seconds)))[:, :3].float()

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Move the rays of a batch, which have times, from the camera's frame to the corrected poses."""
        origins, directions = world_rays(self.pose(raybundle.times[:, 0]), raybundle.metadata[CAMERA_DIRECTIONS])
        raybundle.origins, raybundle.directions = origins.to(raybundle.origins), directions.to(raybundle.directions)

    @torch.no_grad()
    def apply_to_camera(self, camera: Cameras) -> Tensor:
        """Return the poses (N, 3, 4) of cameras in the frame of the corrected poses.

        - Cameras on the estimated trajectory get the corrected poses of their times.
        - Cameras of reference images are moved, with ground truth, by the Sim(3) that best maps the corrected
          trajectory to the true one. Without ground truth they move with the corrected pose of the time when the image
          was taken, or, for images that were not taken on the trajectory, by the Sim(3) to the estimated trajectory.
        - All other cameras are in the scene's frame already and stay.
        """
        poses = camera.camera_to_worlds
        metadata = camera.metadata or {}
        if TRAJECTORY_SECONDS in metadata and self.is_learned:
            return self.pose(metadata[TRAJECTORY_SECONDS][..., 0]).to(poses)
        if REFERENCE_SECONDS not in metadata or (not self.is_learned and not self.has_ground_truth):
            return poses
        carried = self.alignment().inverse()(poses.double())
        if not self.has_ground_truth:
            seconds = metadata[REFERENCE_SECONDS][..., 0]
            taken = seconds.nan_to_num(0.0)
            motion = homogeneous(self.pose(taken)) @ torch.linalg.inv(homogeneous(self.trajectory.pose(taken)))
            moved = (motion @ homogeneous(poses.double()))[:, :3]
            carried = torch.where(seconds.isfinite()[:, None, None], moved, carried)
        return carried.to(poses)

    def world_twists(self, seconds: Tensor, base: Tensor) -> Tensor:
        """Return the float64 twists (N, 6) in the world that correct poses, in scene units and radians.

        The corrected pose is exp(twist) · base pose, to first order base pose + (v + ω × position). What is learned of
        the clock offset adds as many seconds of the twist at which the base pose moves. A finer spline is left out: its
        corrections differ from pose to pose, so no place moves with them.

        Args:
            seconds: (N,) float64 times since the trajectory's start.
            base: (N, 3, 4) base poses at these times, on the clock that training begins with.
        """
        if self.twists is not None:
            twists = self._twist_units * self.twists.slow(seconds, base)
        else:
            twists = base.new_zeros(len(base), 6)
        if self.rigid_offset is not None:
            twists = twists + self._rigid_twists(len(base))
        translation, rotation = (base[:, None, :, :3] @ twists.unflatten(-1, (2, 3, 1)))[..., 0].unbind(1)
        if self.clock_change is not None:
            _, rate = self.trajectory.pose_and_rate(self.on_clock_of_poses(seconds, at_first=True))
            rate = torch.where(self._moves(seconds), rate, 0.0)
            # The derivative of a rotation R is [ω]ₓ R.
            turning = rate[..., :3] @ base[..., :3].mT
            omega = torch.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], -1)
            offset = _MAX_CLOCK_CHANGE * self.clock_change_share()
            translation, rotation = translation + offset * rate[..., 3], rotation + offset * omega
        return torch.cat([translation + torch.linalg.cross(base[..., 3], rotation), rotation], -1)

    def alignment(self) -> Similarity:
        """Return the Sim(3) that best maps most of the corrected trajectory to the true one.

        Where the true trajectory is not known, the estimated one takes its place.
        """
        _, corrected, reference = self.compared_poses()
        return align_most(corrected, reference)

    @torch.no_grad()
    def compared_poses(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return estimated, corrected and reference poses (N, 3, 4) at the same times, in scene units.

        Where there are no true poses, the reference is the estimated trajectory at the times of the corrected clock: an
        offset of the clock moves no place of the world.
        """
        seconds, reference = self._compared_seconds, self._true_poses
        if reference is None:
            reference = self.trajectory.pose(self.on_clock_of_poses(seconds))
        return self.trajectory.pose(seconds), self.pose(seconds), reference

    def ray_rates(self, raybundle: RayBundle) -> tuple[Tensor, Tensor]:
        """Return the derivatives of the corrected rays' origins and directions (N, 3) by time, per second."""
        _, rate = self.pose_and_rate(raybundle.times[:, 0])
        # Rays are linear in the pose.
        origin_rates, direction_rates = world_rays(rate, raybundle.metadata[CAMERA_DIRECTIONS])
        return origin_rates.to(raybundle.origins), direction_rates.to(raybundle.origins)

    def get_loss_dict(self, loss_dict: dict[str, Tensor]) -> None:
        """Add the mean squared size of the corrections over the recording, so that good poses stay as they are."""
        if self.twists is not None and (self.config.trans_l2_penalty or self.config.rot_l2_penalty):
            penalty = (self._penalties * self._sampled_twists().square().mean(0)).sum()
            loss_dict["pose_correction_penalty"] = penalty.float()

    @torch.no_grad()
    def get_metrics_dict(self, metrics_dict: dict[str, Any]) -> None:
        """Add the offsets and the root mean square size of the corrections: scene units, degrees and seconds."""
        metrics_dict |= self.offsets()
        if self.twists is not None:
            twists = (self._twist_units * self._sampled_twists()).unflatten(-1, (2, 3))
            size = twists.square().sum(-1).mean(0).sqrt()
            metrics_dict["pose_correction_translation"] = size[0]
            metrics_dict["pose_correction_degrees"] = torch.rad2deg(size[1])

    @torch.no_grad()
    def offsets(self) -> dict[str, float]:
        """Return the learned offsets by name: seconds, degrees and scene units; none where they are not learned."""
        found = {}
        if self.clock_change is not None:
            found["clock_offset_seconds"] = float(self.clock_offset())
        if self.rigid_offset is not None:
            translation, rotation = self._rigid_twists(1).unflatten(-1, (2, 3)).norm(dim=-1)[0].tolist()
            found["rigid_offset_degrees"] = math.degrees(rotation)
            found["rigid_offset_translation"] = translation
        return found

    def _sampled_twists(self) -> Tensor:
        """Return twists, in units of the trajectory's extent, at times in every interval of the spline."""
        assert self.twists is not None
        return self.twists(self._sampled_seconds, self._sampled_poses)

    def get_param_groups(self, param_groups: dict[str, list[nn.Parameter]]) -> None:
        """Add the parameters as the groups ``camera_opt`` and, of a finer spline, ``camera_opt_finer``, if any."""
        for name, parameter in self.named_parameters():
            group = "camera_opt_finer" if ".finer." in name else "camera_opt"
            param_groups.setdefault(group, []).append(parameter)


def world_rays(poses: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return origins and unit directions (N, 3) in the world for rays in the camera's frame.

    Args:
        poses: (N, 3, 4) camera-to-world.
        directions: (N, 3) unit vectors in the camera's frame.
    """
    return poses[:, :, 3], (poses[:, :, :3] @ directions[..., None])[..., 0]


def _jitter(trajectory: Trajectory, extent: float) -> float:
    """Return the median distance of every second pose from the motion through the others, in radians and extents."""
    times, poses = trajectory.times, trajectory.camera_to_worlds
    if len(times) < 3:
        return 0.0
    smooth = Trajectory(times[::2], poses[::2], trajectory.source).interpolate(times[1:-1:2])
    distances = (smooth - poses[1:-1:2])[..., 3].norm(dim=-1) / extent
    return float(torch.hypot(rotation_angle(smooth, poses[1:-1:2]), distances).median())


def _compared_times(trajectory: Trajectory, ground_truth: Trajectory | None) -> Tensor:
    """Return times in nanoseconds of at most _MAX_COMPARED knots that the ground truth covers."""
    times = trajectory.times if ground_truth is None else trajectory.knots_covered_by(ground_truth)
    count = min(len(times), _MAX_COMPARED)
    return times[torch.linspace(0, len(times) - 1, count, dtype=torch.float64).round().long()]


class TwistNetwork(nn.Module):
    """The paper's pose correction network (appendix, algorithm 1; softplus as in its text), but it puts out a twist.

    The paper's puts out the corrected pose itself. A twist can be zero before training.

    Args:
        trajectory: estimated trajectory, whose span the times lie in.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__()
        self._duration = trajectory.duration
        width = 256
        self.pose_embedding = nn.Linear(13, width)
        self.time_embedding = nn.Linear(1, width)
        self.encoding = NeRFEncoding(width, num_frequencies=3, min_freq_exp=0.0, max_freq_exp=2.0, include_input=True)
        layers: list[nn.Module] = []
        size = self.encoding.get_out_dim()
        for _ in range(4):
            linear = nn.Linear(size, width)
            # With PyTorch's initialization and a blunt softplus, hardly any variation of the input reaches the output:
            # for long, such a network learns only one correction for all times.
            nn.init.kaiming_normal_(linear.weight)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Softplus(beta=100)]
            size = width
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(width, 6)
        # No correction before training. The gradient of these weights is not zero.
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, seconds: Tensor, base: Tensor) -> Tensor:
        """Return float64 twists (N, 6) at (N,) seconds, for estimated poses (N, 3, 4)."""
        if len(seconds) > _CHUNK and not torch.is_grad_enabled():
            return torch.cat([self(*part) for part in zip(seconds.split(_CHUNK), base.split(_CHUNK), strict=True)])
        dtype = self.output.weight.dtype
        time = (2 * seconds / self._duration - 1).to(dtype)[:, None]
        # Half precision cannot tell the two ends of an interval apart.
        with torch.autocast(time.device.type, enabled=False):
            pose = self.pose_embedding(torch.cat([base.flatten(1).to(dtype), time], -1))
            embedded = F.softplus(pose) + F.softplus(self.time_embedding(time))
            return (_NETWORK_OUTPUT_SCALE * self.output(self.hidden(self.encoding(embedded)))).double()

    slow = forward

    def with_rate(self, seconds: Tensor, base: Tensor, base_rate: Tensor) -> tuple[Tensor, Tensor]:
        """Return float64 twists and their rates per second (N, 6), for estimated poses and their rates (N, 3, 4)."""
        with forward_ad.dual_level():
            moving = forward_ad.make_dual(seconds, torch.ones_like(seconds)), forward_ad.make_dual(base, base_rate)
            twist, rate = forward_ad.unpack_dual(self(*moving))
        return twist, rate


class TwistSpline(nn.Module):
    """A uniform cubic B-spline of twists, on which a finer one can be added.

    Args:
        duration: seconds it spans.
        knot_interval: seconds between knots.
        with_finer: add a spline whose knots are four times closer.
    """

    def __init__(self, duration: float, knot_interval: float, with_finer: bool = False) -> None:
        super().__init__()
        self.finer = TwistSpline(duration, knot_interval / _FINER) if with_finer else None
        self._segments = math.ceil(duration / knot_interval)
        self._interval = duration / self._segments
        self.control_twists = nn.Parameter(torch.zeros(self._segments + 3, 6))
        # https://en.wikipedia.org/wiki/B-spline, the uniform cubic basis: row k has the factors of uᵏ.
        basis = torch.tensor(
            [[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]],
            dtype=torch.float64,
        )
        basis /= 6
        # The rate is analytic: forward-mode differentiation would add some 40 kernel launches to a GPU's step.
        rate = torch.zeros(4, 4, dtype=torch.float64)
        rate[:3] = basis[1:] * torch.tensor([[1.0], [2.0], [3.0]]) / self._interval
        self._basis: Tensor = nn.Buffer(torch.cat([basis, rate], -1), persistent=False)
        self._exponents: Tensor = nn.Buffer(torch.arange(4, dtype=torch.float64), persistent=False)
        self._near: Tensor = nn.Buffer(torch.arange(4), persistent=False)

    def forward(self, seconds: Tensor, base: Tensor) -> Tensor:
        """Return float64 twists (N, 6) at (N,) seconds. The poses play no part."""
        twist = self.slow(seconds, base)
        return twist if self.finer is None else twist + self.finer(seconds, base)

    def slow(self, seconds: Tensor, base: Tensor) -> Tensor:
        """Return the twists of :meth:`forward` without the finer spline."""
        return self._evaluate(seconds, self._basis[:, :4])[:, 0]

    def with_rate(self, seconds: Tensor, base: Tensor, base_rate: Tensor) -> tuple[Tensor, Tensor]:
        """Return float64 twists and their rates per second (N, 6). The poses play no part."""
        twist, rate = self._evaluate(seconds, self._basis).unbind(1)
        if self.finer is not None:
            finer, finer_rate = self.finer.with_rate(seconds, base, base_rate)
            twist, rate = twist + finer, rate + finer_rate
        return twist, rate

    def _evaluate(self, seconds: Tensor, basis: Tensor) -> Tensor:
        """Return sums (N, count, 6) of control twists by the functions (4, 4 count) of ``basis``."""
        position = seconds / self._interval
        segment = position.detach().long().clamp(0, self._segments - 1)
        functions = ((position - segment)[:, None] ** self._exponents) @ basis
        # In float64, because autocast would round the products of float32.
        near = self.control_twists[segment[:, None] + self._near].double()
        return functions.unflatten(-1, (-1, 4)) @ near
