"""The pipeline: fits the colour correction, checks every step, loads strictly and evaluates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import comms
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.utils.writer import GLOBAL_BUFFER, EventName
from torch import Tensor

from aenerf_ns.camera.alignment import pose_errors
from aenerf_ns.camera.trajectory import OPENCV_TO_OPENGL, homogeneous
from aenerf_ns.method.color_correction import NoColorCorrection
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol
from aenerf_ns.method.model import AENeRFModel
from aenerf_ns.training.datamanager import EventDataManager
from aenerf_ns.training.device import require_device
from aenerf_ns.training.ffmpeg import provide_ffmpeg
from aenerf_ns.training.pose_diagnosis import LAST_PART, diagnose
from aenerf_ns.training.pose_refinement import NUM_STEPS, RefinedViews
from aenerf_ns.training.training_state import TrainingState
from aenerf_ns.training.view_metrics import (
    IMAGE_METRICS,
    average_metrics,
    describe_views,
    measure_views,
    picture_names,
)
from aenerf_ns.viewer.panel import RecordingPanel
from aenerf_ns.viewer.recording_view import RecordingView

# Steps between rough fits of the colour correction, on a share of its pixels, for the viewer's picture while training.
_ROUGH_FIT_INTERVAL = 50
_ROUGH_FIT_SHARE = 1 / 8
# Steps between the errors of the corrected poses in the log, where true ones are known.
_POSE_ERROR_INTERVAL = 100


@dataclass
class AENeRFPipelineConfig(VanillaPipelineConfig):
    """Pipeline of an event datamanager and an AE-NeRF model."""

    _target: type = field(default_factory=lambda: AENeRFPipeline)
    refine_test_poses: bool = True
    """Evaluate a trained run a second time, with test poses that are refined photometrically. Besides the picture, that
    takes some 13,000 rays a view and their gradients."""


@dataclass(frozen=True)
class _Pixels:
    """Pixels that a colour correction is fitted on.

    Attributes:
        cameras: of the views.
        view: (N, 1) index of each pixel's camera.
        coordinates: (N, 2) row and column.
        radiance: (N, channels) of the reference image there, or None where there are no references.
    """

    cameras: Cameras
    view: Tensor
    coordinates: Tensor
    radiance: Tensor | None = None


class AENeRFPipeline(VanillaPipeline):
    """Fits the colour correction before each checkpoint, and evaluates with the one in the checkpoint."""

    config: AENeRFPipelineConfig
    datamanager: EventDataManager
    model: AENeRFModel

    def __init__(
        self,
        config: AENeRFPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        **kwargs: Any,
    ) -> None:
        require_device(device)
        if test_mode != "val":
            # Once the pipeline is made, ns-render asks for a program that pip cannot install.
            provide_ffmpeg()
        super().__init__(config, device, test_mode=test_mode, **kwargs)
        self._pose_diagnosis: dict[str, Any] | None = None
        self.training_state = TrainingState()
        if test_mode != "inference":
            self.datamanager.supervise(self.model.supervision)
        # Chosen once: otherwise every fit would read the images again.
        self._pixels_of_split: dict[str, _Pixels] = {}
        self._unchecked_losses: dict[str, Tensor] = {}
        self._steps_per_log = 1
        self._warn_of_test_views()
        # The viewer finds its elements there, where one runs.
        self.recording = RecordingPanel(
            RecordingView(self.model, self.datamanager.train_dataset, self.in_recording, self.pose_errors)
        )

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:
        """Load all of a checkpoint. The framework would silently drop what does not fit.

        Raises:
            RuntimeError: the checkpoint belongs to a model with other parameters.
        """
        super().load_state_dict(state_dict, strict=True)
        if self.test_mode != "val":
            # The framework's renderers and exporters derive their own cameras from these cameras.
            data, correction = self.datamanager, self.model.camera_optimizer
            if data.has_reference_views:
                data.place_reference_views(correction.apply_to_camera(data.eval_dataset.cameras.to(self.device)))
            data.place_training_cameras(correction.apply_to_camera(data.train_dataset.cameras.to(self.device)))
            correction.training_cameras_are_corrected = True

    def get_extra_state(self) -> dict[str, Any] | None:
        """Return the diagnosis of the pose correction, which checkpoints hold; None before the last step."""
        return self._pose_diagnosis

    def set_extra_state(self, state: dict[str, Any] | None) -> None:
        """Take the diagnosis of the pose correction from a checkpoint."""
        self._pose_diagnosis = state

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Any]]:
        """Return outputs, weighted losses and metrics of a training batch.

        There are metrics only at the steps that the trainer logs, with the pairs that are trained on in a second, and
        with the errors of the corrected poses if the step is a multiple of 100. The losses are checked after the
        backward pass, together with the gradients.
        """
        rays, batch = self.datamanager.next_train(step)
        # In several processes the model is wrapped in DistributedDataParallel.
        outputs = self._model(rays)
        metrics = {}
        if step_check(step, self._steps_per_log, run_at_zero=True):
            metrics = self.model.get_metrics_dict(outputs, batch) | self._rate(batch)
            if step_check(step, _POSE_ERROR_INTERVAL, run_at_zero=True):
                errors = self.pose_errors()
                if errors is not None:
                    metrics |= errors["corrected"]
        losses = self.model.get_loss_dict(outputs, batch, metrics)
        self._unchecked_losses = losses
        return outputs, losses, metrics

    def _rate(self, batch: Mapping[str, Any]) -> dict[str, float]:
        """Return ``pairs_per_second`` at the framework's mean time of a step, where a batch holds pairs of times."""
        # The framework has no mean before the first step, and none outside a training.
        times = GLOBAL_BUFFER.get("events", {}).get(EventName.ITER_TRAIN_TIME.value)
        if times is None or "num_positive" not in batch:
            return {}
        return {"pairs_per_second": comms.get_world_size() * len(batch["num_positive"]) / times["avg"]}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return all callbacks, with the colour correction's and the diagnosis', and let optimizers check gradients."""
        trainer = training_callback_attributes.trainer
        assert trainer is not None
        # Saved again, because the dataparser has resolved the time window by now: opening the run must give the same
        # cameras without reading the events.
        if trainer.local_rank == 0:
            trainer.config.save_config()
        num_steps = trainer.config.max_num_iterations
        last_step = trainer._start_step + num_steps - 1
        self.training_state.go_on(trainer, self.model.proposal_sampler)
        # A run that goes on from a checkpoint is diagnosed anew at its own end.
        self._pose_diagnosis = None
        earlier_poses: list[Tensor] = []

        def diagnose_poses(step: int) -> None:
            if not self.model.camera_optimizer.is_learned or not comms.is_main_process():
                return
            if step == max(last_step - max(round(LAST_PART * num_steps), 1), trainer._start_step):
                earlier_poses.append(self.model.camera_optimizer.compared_poses()[1])
            if step == last_step:
                self._pose_diagnosis = diagnose(self, *earlier_poses)
                CONSOLE.print(self._pose_diagnosis["summary"], soft_wrap=True)

        def fit(step: int) -> None:
            # The main process writes the checkpoints, and DistributedDataParallel copies its buffers to the others.
            if not comms.is_main_process():
                return
            if step == last_step or step_check(step, trainer.config.steps_per_save):
                self.fit_color_correction()
            elif step_check(step, _ROUGH_FIT_INTERVAL, run_at_zero=True):
                self.fit_color_correction(_ROUGH_FIT_SHARE)

        def check_losses(step: int) -> None:
            # With mixed precision only the losses are left to check. The scaler drops gradients that are not finite. If
            # the losses are not, it would silently drop every step's from now on.
            if self._unchecked_losses:
                self._require_finite([], step)

        self._steps_per_log = trainer.config.logging.steps_per_log
        optimizers = list(trainer.optimizers.optimizers.values())

        def check(*_: Any) -> None:
            # The first optimizer of a step looks at all gradients. Mixed precision's are still scaled here.
            if self._unchecked_losses and not trainer.grad_scaler.is_enabled():
                self._require_finite(optimizers, trainer.step)

        for optimizer in optimizers:
            optimizer.register_step_pre_hook(check)
        # After every step, because the trainer saves its last checkpoint before it calls the callbacks for the end.
        callbacks = [
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], function, update_every_num_iters=1)
            for function in (check_losses, diagnose_poses, fit, lambda step: self.recording.after_step())
        ]
        return [*super().get_training_callbacks(training_callback_attributes), *callbacks]

    def replace_color_correction(self, protocol: ColorCorrectionProtocol) -> None:
        """Replace the run's colour correction by another protocol, fitted anew on the run's data."""
        self.model.color_correction = self.model.new_color_correction(protocol).to(self.device)
        self._warn_of_test_views()
        self.fit_color_correction()

    def _require_finite(self, optimizers: list[torch.optim.Optimizer], step: int) -> None:
        """Raise SystemExit unless the step's losses and the gradients of optimizers are finite.

        The CPU waits for the GPU once a call, however many values there are. That is the price of stopping before the
        first weight is lost.
        """
        losses, self._unchecked_losses = self._unchecked_losses, {}
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        parameters = [p for group in groups for p in group["params"] if p.grad is not None]
        # Adam squares gradients: it cannot use a gradient whose norm overflows.
        norms = torch._foreach_norm([parameter.grad for parameter in parameters]) if parameters else ()
        values = torch.stack([*(loss.detach() for loss in losses.values()), *norms]).tolist()
        if all(map(math.isfinite, values)):
            return
        name_of = {parameter: name for name, parameter in self.model.named_parameters()}
        names = [*losses, *(name_of[parameter] for parameter in parameters)]
        bad = [f"{name} {value:g}" for name, value in zip(names, values, strict=True) if not math.isfinite(value)]
        # A loss that is not finite is the cause of gradients that are not.
        bad_losses = [line for line in bad if line.split()[0] in losses]
        what, bad = ("loss", bad_losses) if bad_losses else ("gradient", bad)
        raise SystemExit(
            f"Error: step {step}: {what} not finite ({', '.join(bad)}), training stopped before this reached the "
            "weights; go on from the last checkpoint or start again, with lower learning rates, without "
            "--mixed-precision if on, and with poses of sensible scale"
        )

    @torch.no_grad()
    def fit_color_correction(self, share: float = 1.0) -> None:
        """Fit the colour correction on its protocol's reference views.

        Without such views, the percentiles of the training cameras' renderings are stretched over the display's range.

        Args:
            share: share of the configured number of pixels to fit on. A share below 1 makes a rough fit.
        """
        correction = self.model.color_correction
        if isinstance(correction, NoColorCorrection):
            return
        if correction.split not in self._pixels_of_split:
            self._pixels_of_split[correction.split] = self._pixels(correction.split)
        pixels = self._pixels_of_split[correction.split]
        count = max(round(share * len(pixels.view)), 1)
        # Reference views are carried over to the frame that the corrected poses have at this step.
        cameras = replace(pixels.cameras, camera_to_worlds=self.model.camera_optimizer.apply_to_camera(pixels.cameras))
        rays = cameras.generate_rays(pixels.view[:count], coords=pixels.coordinates[:count])
        log_radiance = self.model.render_log_radiance(rays)
        if pixels.radiance is None:
            correction.stretch(log_radiance)
        else:
            correction.fit(log_radiance, pixels.radiance[:count], len(cameras), rough=share < 1)

    def _warn_of_test_views(self) -> None:
        if self.model.color_correction.protocol == "affine-test":
            CONSOLE.print(
                "[yellow]Colour correction affine-test is fitted on the test views themselves: only to compare with "
                "figures that were made so."
            )

    def _pixels(self, split: Literal["val", "test"]) -> _Pixels:
        """Return random pixels of all reference views of a split, the same in every run.

        Without references the pixels are those of the training cameras.
        """
        references = self.datamanager.reference_views(split)
        views = references or self.datamanager.train_dataset
        generator = torch.Generator().manual_seed(0)
        cameras = views.cameras
        count = max(self.model.config.color_correction_num_rays, len(views))
        # Every view is drawn as often as the others, in random order, so any part is spread over the views too.
        index = (torch.arange(count) % len(views))[torch.randperm(count, generator=generator)]
        size = torch.cat([cameras.height, cameras.width], -1)[index]
        pixels = (torch.rand(count, 2, generator=generator) * size).long()
        device = self.device
        chosen = _Pixels(cameras.to(device), index[:, None].to(device), (pixels + 0.5).to(device))
        if references is None:
            return chosen
        image = torch.zeros(count, 3)
        for view in range(len(views)):
            rows, columns = pixels[index == view].T
            image[index == view] = views.get_image_float32(view)[rows, columns, :3]
        return replace(chosen, radiance=self.model.reference_radiance(image).to(device))

    def in_recording(self, poses: Tensor) -> Tensor:
        """Convert scene poses (N, 3, 4) with OpenGL axes to the recording's world and units, with OpenCV axes."""
        outputs = self.datamanager.train_dataparser_outputs
        to_scene = homogeneous(outputs.dataparser_transform.double())
        poses = homogeneous(poses.cpu())
        poses[:, :3, 3] /= outputs.dataparser_scale
        return (torch.linalg.inv(to_scene) @ poses @ OPENCV_TO_OPENGL)[:, :3]

    def in_scene(self, poses: Tensor) -> Tensor:
        """Convert poses (N, 3, 4) or (N, 4, 4) of the recording's world, OpenCV axes, to scene poses, OpenGL axes."""
        outputs = self.datamanager.train_dataparser_outputs
        poses = homogeneous(outputs.dataparser_transform.double()) @ homogeneous(poses[:, :3].cpu()) @ OPENCV_TO_OPENGL
        poses[:, :3, 3] *= outputs.dataparser_scale
        return poses[:, :3]

    def camera_speeds(self, seconds: Tensor) -> tuple[Tensor, Tensor]:
        """Return how fast the corrected camera moves and turns at (N,) float64 seconds since the trajectory's start.

        Returns:
            (N,) units of the recording per second, and (N,) degrees per second.
        """
        with torch.no_grad():
            pose, rate = self.model.camera_optimizer.pose_and_rate(seconds.to(self.device))
        scale = self.datamanager.train_dataparser_outputs.dataparser_scale
        # The derivative of a rotation R is R [ω]ₓ, whose norm is √2 |ω|.
        turning = (pose[..., :3].mT @ rate[..., :3]).flatten(1).norm(dim=-1) / math.sqrt(2)
        return rate[..., 3].norm(dim=-1).cpu() / scale, torch.rad2deg(turning).cpu()

    def pose_errors(self) -> dict[str, dict[str, float]] | None:
        """Return the errors of the ``estimated`` and of the ``corrected`` poses, in the units of the recording.

        They are those of :func:`~aenerf_ns.camera.alignment.pose_errors`. None where the true poses are not known.
        """
        correction = self.model.camera_optimizer
        if not correction.has_ground_truth:
            return None
        estimated, corrected, reference = (self.in_recording(poses) for poses in correction.compared_poses())
        return {"estimated": pose_errors(estimated, reference), "corrected": pose_errors(corrected, reference)}

    def _require_reference_views(self) -> None:
        if not self.datamanager.has_reference_views:
            raise SystemExit(
                f"Error: {self.datamanager.get_datapath()}: the {self.datamanager.test_split} split has no reference "
                "images to evaluate on; ns-render shows what was reconstructed"
            )

    @property
    def test_poses(self) -> str:
        """How the cameras of the reference views are placed."""
        if self.model.camera_optimizer.has_ground_truth:
            return "Sim(3) of the corrected to the true trajectory"
        if not self.model.camera_optimizer.is_learned:
            return "as the dataset gives them"
        return "corrected pose at the time of the view, else Sim(3) of the corrected to the estimated trajectory"

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Return mean metrics over the reference views, and the protocol that they were computed with.

        The views are rendered from where they are placed. Of a trained run, ``refined_test_poses`` holds the metrics of
        the views that are rendered from photometrically refined poses, and ``views`` those of each view
        (:func:`~aenerf_ns.training.view_metrics.describe_views`). No camera stays moved.

        Without reference views, but with known true poses, return the errors of the poses alone.

        Raises:
            SystemExit: there are neither views nor true poses; or, outside training, a metric is not a number.
        """
        metrics: dict[str, Any] = {}
        placed: list[dict[str, float]] = []
        refined = None
        if self.datamanager.has_reference_views or not self.model.camera_optimizer.has_ground_truth:
            self._require_reference_views()
            placed = self._measure(self.datamanager.fixed_indices_eval_dataloader, output_path)
            metrics = self._checked(average_metrics(placed, get_std))
        if self.test_mode == "test":
            # In the other mode, the trainer's log takes numbers only.
            metrics["color_correction"] = self.model.color_correction.description
            metrics["num_views"] = len(self.datamanager.eval_dataset) if self.datamanager.has_reference_views else 0
            metrics["pose_correction"] = self.model.config.camera_optimizer.mode
            metrics |= self.model.camera_optimizer.offsets()
            metrics["pose_errors"] = self.pose_errors()
            metrics["pose_diagnosis"] = self._pose_diagnosis
            metrics["test_poses"] = self.test_poses
            if metrics["num_views"] and self.config.refine_test_poses:
                refined = self._measure(RefinedViews(self.model, self.datamanager.fixed_indices_eval_dataloader))
                metrics["refined_test_poses"] = self._metrics_of_refined_test_poses(refined, get_std)
            metrics |= self.model.supervision.learned()
            if self.model.image_metrics.lpips_absent is not None:
                metrics["lpips"] = None
                metrics["lpips_absent"] = self.model.image_metrics.lpips_absent
            metrics["views"] = describe_views(self, placed, refined) if placed else []
        return metrics

    def _measure(
        self, views: Iterable[tuple[Cameras, dict[str, Any]]], output_path: Path | None = None
    ) -> list[dict[str, float]]:
        """Return the metrics of each reference view, and write its pictures as ns-eval names them."""
        self.eval()
        names = picture_names(self.datamanager.eval_dataset.image_filenames)
        measured = measure_views(self.model, views, names, output_path, "eval")
        self.train()
        return measured

    def _metrics_of_refined_test_poses(self, refined: list[dict[str, float]], get_std: bool) -> dict[str, Any]:
        """Return the mean metrics of the reference views from refined poses, and how the poses were refined."""
        metrics = self._checked(average_metrics(refined, get_std))
        # The time to render includes no refinement, so it says nothing new.
        metrics = {name: value for name, value in metrics.items() if name.removesuffix("_std") in IMAGE_METRICS}
        if self.model.image_metrics.lpips_absent is not None:
            metrics["lpips"] = None
        how = f"photometric refinement, {NUM_STEPS} Levenberg-Marquardt steps, from: {self.test_poses}"
        return {**metrics, "test_poses": how}

    def _checked(self, metrics: dict[str, Any]) -> dict[str, Any]:
        """Return metrics of the reference views without standard deviations that do not exist.

        Raises:
            SystemExit: outside training, a metric is not a number.
        """
        # A single view has no standard deviation, and JSON has no NaN.
        metrics = {k: value for k, value in metrics.items() if not (k.endswith("_std") and math.isnan(value))}
        undefined = [name for name, value in metrics.items() if math.isnan(value)]
        if undefined and self.test_mode == "test":
            raise SystemExit(
                f"Error: {', '.join(undefined)} of the {self.datamanager.test_split} views is not a number: "
                "the run renders values that are not finite; train it again"
            )
        return metrics
