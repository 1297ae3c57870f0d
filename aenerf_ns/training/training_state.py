"""The state of a training beyond weights, optimizers and schedules, which Nerfstudio's checkpoints lack."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import comms
from torch import nn

from aenerf_ns.errors import DataError
from aenerf_ns.method.ray_samplers import ProposalSampler
from aenerf_ns.recording.scene import SceneRecording


class TrainingState(nn.Module):
    """Carries the state of a training in checkpoints, so that 100 steps and 100 more are the steps of a run of 200.

    The state holds torch's random generators, the gradients that are being accumulated over steps
    (``gradient_accumulation_steps``), the step at which the proposal networks were last trained, the number of steps
    that the schedules are made for, where the scene is in the world of the recording, and what the weights depend on.

    Args:
        scene: that is trained on.
        data: the dataset, for error messages.
        options: of the model, by their names, that the weights depend on though their number does not.
    """

    def __init__(self, scene: SceneRecording, data: Path, options: dict[str, Any]) -> None:
        super().__init__()
        self._options = options
        frame = scene.frame
        # The (3, 4) float64 map from the recording's world to the scene's: its rotation is scaled.
        self._scene_frame = torch.cat([frame.scale * frame.rotation, frame.translation[:, None]], -1)
        self._data = data
        self._training: tuple[Trainer, ProposalSampler] | None = None
        self._loaded: dict[str, Any] | None = None

    def get_extra_state(self) -> dict[str, Any] | None:
        """Return the state now, in tensors and plain values; None of a pipeline that is not training."""
        if self._training is None:
            return None
        trainer, sampler = self._training
        accumulating = {
            group: [parameter.grad for parameter in parameters]
            for group, parameters in trainer.optimizers.parameters.items()
            # The gradients of the other groups have been used, and are cleared before the next step.
            if (trainer.step + 1) % trainer.gradient_accumulation_steps[group] != 0
        }
        return {
            "random_generator": torch.get_rng_state(),
            "cuda_random_generator": torch.cuda.get_rng_state(trainer.device) if _is_on_gpu(trainer) else None,
            "gradients": accumulating,
            "proposal_sampler": sampler.schedule_state(),
            "schedule_length": trainer.config.schedule_length,
            "scene_frame": self._scene_frame,
            "options": self._options,
        }

    def set_extra_state(self, state: dict[str, Any] | None) -> None:
        """Take a checkpoint's state, for :meth:`resume`. Evaluations load it too, and it does not affect them.

        Raises:
            DataError: the checkpoint is of a scene that is elsewhere: its field and corrections would be, too. Or its
                weights are of other options, with which they show another scene.
        """
        # Checkpoints of earlier versions do not say.
        before, now = None if state is None else state.get("scene_frame"), self._scene_frame
        if before is not None and not torch.allclose(before, now, rtol=1e-5, atol=1e-5 * float(now.abs().max())):
            raise DataError(
                self._data,
                "its scene is scaled, turned or moved otherwise than that of the checkpoint (scene units to a unit of "
                f"the recording: {now[:, 0].norm():.5g}, there {before[:, 0].norm():.5g})",
                "give the dataset, time window, scale and other options of the format of that run, or train again",
            )
        for name, learned in ({} if state is None else state.get("options", {})).items():
            own = self._options.get(name, learned)
            if own != learned:
                remedy = "give the method and the options of that run, or train again"
                raise DataError("model", f"{name} is {own}, and {learned} in the checkpoint", remedy)
        self._loaded = state

    def resume(self, trainer: Trainer, sampler: ProposalSampler) -> None:
        """Attach to a trainer, and restore the loaded state if there is one.

        Args:
            trainer: of an :class:`~aenerf_ns.training.trainer.AENeRFTrainerConfig`, with its checkpoint loaded.
            sampler: of the model that is trained.
        """
        self._training = (trainer, sampler)
        state, self._loaded = self._loaded, None
        if state is None:
            return
        for group, gradients in state["gradients"].items():
            for parameter, gradient in zip(trainer.optimizers.parameters[group], gradients, strict=True):
                parameter.grad = None if gradient is None else gradient.to(parameter)
        sampler.load_schedule_state(state["proposal_sampler"])
        if trainer.config.load_scheduler:
            trainer.config.schedule_length = state["schedule_length"]
        torch.set_rng_state(state["random_generator"])
        if state["cuda_random_generator"] is not None and _is_on_gpu(trainer):
            torch.cuda.set_rng_state(state["cuda_random_generator"], trainer.device)
        if not comms.is_main_process():
            # The main process alone writes checkpoints. The others must draw batches of their own.
            torch.manual_seed(int(torch.randint(1 << 62, ())) + comms.get_rank())


def _is_on_gpu(trainer: Trainer) -> bool:
    return torch.device(trainer.device).type == "cuda"
