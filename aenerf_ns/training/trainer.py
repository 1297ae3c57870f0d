"""Nerfstudio's trainer, with schedules of the run's length, whole checkpoints, and a record of the run."""

from __future__ import annotations

import errno
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms
from nerfstudio.utils.decorators import check_main_thread

from aenerf_ns.atomic_write import atomic_write
from aenerf_ns.errors import DataError, errors_as_one_line
from aenerf_ns.files.output_paths import require_writable
from aenerf_ns.training import framework
from aenerf_ns.training.checkpoints import checkpoint_to_load, newest_first, step_of, warn_of_later_checkpoints
from aenerf_ns.training.preflight import require_device
from aenerf_ns.training.run_record import RunRecord, ScalarWriter
from aenerf_ns.training.schedules import RelativeCosineSchedulerConfig, RelativeMultiStepSchedulerConfig

# The focal length in pixels up to which a spline of poses learns at the rates of the configuration. Beyond it, the same
# step in radians is so many pixels that poses tremble until late in the run (docs/defaults.md).
_FOCAL_LENGTH = 250.0


@dataclass
class AENeRFTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer, which tells the schedules how long the run is."""

    _target: type = field(default_factory=lambda: AENeRFTrainer)
    schedule_length: int | None = None
    """Steps that the schedules are made for, if the run is made in pieces: the steps of all pieces. The first piece
    takes the option. The others take the length from the checkpoint. None: max-num-iterations."""

    def __post_init__(self) -> None:
        for group in self.optimizers.values():
            if isinstance(group["scheduler"], (RelativeMultiStepSchedulerConfig, RelativeCosineSchedulerConfig)):
                group["scheduler"].max_steps = self.schedule_length or self.max_num_iterations

    def set_experiment_name(self) -> None:
        """Name the run after the event file, where one is given in place of a folder. Nerfstudio names it after the
        file's folder, whose name is empty for a relative path."""
        data = self.pipeline.datamanager.data
        if self.experiment_name is None and data is not None and data.is_file():
            self.experiment_name: str | None = data.stem
        super().set_experiment_name()

    def get_base_dir(self) -> Path:
        """Return the folder of the run: where its config.yml is, for commands that open it, wherever it was trained."""
        return self.__dict__.get("opened_folder") or _folder_of_opened_run() or super().get_base_dir()

    @property
    def load_step(self) -> int | None:
        """The step to load: the one that was asked for, or that of the newest whole checkpoint, where a run is opened.

        Nerfstudio's commands that open a run set ``load_dir`` to its own folder, and then ask for this step. Without an
        answer they would load the last file, whole or not.

        Raises:
            SystemExit: the run has no whole checkpoint.
        """
        asked: int | None = vars(self).get("load_step")
        if asked is None and self.load_dir is not None and self.load_dir == self.get_checkpoint_dir():
            with errors_as_one_line():
                return step_of(checkpoint_to_load(self.load_dir))
        return asked

    @load_step.setter
    def load_step(self, step: int | None) -> None:
        self.__dict__["load_step"] = step

    def save_config(self) -> None:
        """Check the options. The trainer saves them when the dataset has resolved those that were left open.

        ns-train calls this once, before it starts the processes of a training.

        Raises:
            SystemExit: with one clear line, when the training cannot run with them.
        """
        numbers = {
            "max-num-iterations": self.max_num_iterations,
            "pipeline.datamanager.train-num-rays-per-batch": self.pipeline.datamanager.train_num_rays_per_batch,
        }
        for group, steps in self.gradient_accumulation_steps.items():
            numbers[f"gradient-accumulation-steps.{group.replace('_', '-')}"] = steps
        with errors_as_one_line():
            require_device(self.machine.device_type)
            for name, value in numbers.items():
                if value < 1:
                    raise DataError("ns-train", f"--{name} {value}", "give one or more")


def _folder_of_opened_run() -> Path | None:
    """Return the folder of the config.yml that a command of Nerfstudio opens: it tells the configuration no path."""
    if Path(sys.argv[0]).name not in ("ns-eval", "ns-render", "ns-export", "ns-viewer"):
        return None
    words = [part for word in sys.argv[1:] for part in (word, word.partition("=")[2])]
    configs = [Path(word).absolute() for word in words if word.endswith("config.yml") and Path(word).is_file()]
    return configs[0].parent if configs else None


class AENeRFTrainer(Trainer):
    """Trainer that saves checkpoints whole or not at all, and resumes from whole ones.

    Raises:
        SystemExit: with one clear line, when the checkpoint to resume from cannot be loaded or the disk is full.
    """

    config: AENeRFTrainerConfig
    checkpoint_dir: Path

    def __init__(self, config: AENeRFTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        length = config.max_num_iterations if config.schedule_length is None else config.schedule_length
        changes: dict[str, Any] = {"schedule_length": length}
        with errors_as_one_line():
            if length < 1:
                raise DataError("ns-train", f"the schedules' length is {length} steps", "give one or more")
            source = config.load_dir or config.load_checkpoint
            if source is not None:
                # As one path: commands that open this run would look for a load_step among its own checkpoints.
                checkpoint = checkpoint_to_load(source, config.load_step)
                changes |= {"load_checkpoint": checkpoint, "load_dir": None, "load_step": None}
            elif config.load_step is not None:
                problem = f"--load-step {config.load_step} names no run"
                raise DataError("ns-train", problem, "give the run with --load-dir, too")
        self._record: RunRecord | None = None
        # The number of the signal that asked the training to stop, or 0.
        self._stopped_by = 0
        super().__init__(replace(config, **changes), local_rank, world_size)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Read the data, make the model, load a checkpoint to resume from, and save the configuration."""
        with (
            errors_as_one_line(),
            _full_disk_as_one_line(self.base_dir),
            _missing_key_as_one_line(self.config.vis),
            _interrupt_as_exit_status(self.world_size),
        ):
            require_writable(self.base_dir / "config.yml", "--output-dir")
            # The viewer writes there before there is a configuration.
            self.base_dir.mkdir(parents=True, exist_ok=True)
            super().setup(test_mode)
            self._steps = framework.steps_of(self)
            if not self._steps:
                raise DataError("ns-train", f"the checkpoint is of step {self._steps.start - 1}", "take more steps")
            if not comms.is_main_process():
                return
            warn_of_later_checkpoints(self.checkpoint_dir, self._steps.start)
            framework.set_end(self._steps.stop)
            framework.add_writer(ScalarWriter(self.base_dir, resumes=self._steps.start > 0))
            self._record = RunRecord(self.base_dir, self.config.machine.seed, self._steps)
            # After the last checkpoint, and before the viewer waits for the user to end it.
            places = TrainingCallbackLocation
            self.callbacks.append(TrainingCallback([places.AFTER_TRAIN], self._record_end))
            # First of all that comes before a step: the last step has then been logged and evaluated.
            self.callbacks.insert(0, TrainingCallback([places.BEFORE_TRAIN_ITERATION], self._stop_if_asked))
            with _one_line_if_not_written(self.base_dir / "config.yml") as path, atomic_write(path) as partial:
                # With what the dataset has resolved: opening the run must give the same cameras.
                data = self.pipeline.datamanager.resolved_config()
                resolved = replace(self.config, pipeline=replace(self.config.pipeline, datamanager=data))  # type: ignore[call-arg]
                partial.write_text(yaml.dump(resolved), "utf8")

    def setup_optimizers(self) -> Optimizers:
        """Return the optimizers, with lower rates for a spline of poses where the camera's focal length is long."""
        optimizers = deepcopy(self.config.optimizers)
        if self.pipeline.model.config.camera_optimizer.mode == "spline":
            focal_length = self.pipeline.datamanager.train_dataset.scene.event_camera.fx
            for name in optimizers.keys() & {"camera_opt", "camera_opt_finer"}:
                optimizers[name]["optimizer"].lr *= min(_FOCAL_LENGTH / focal_length, 1.0)
        return Optimizers(optimizers, self.pipeline.get_param_groups())

    def _load_checkpoint(self) -> None:
        try:
            super()._load_checkpoint()
        except torch.cuda.OutOfMemoryError:
            raise
        # torch's, for weights and for the state of an optimizer.
        except (RuntimeError, ValueError) as error:
            problem = f"it holds other parameters than this training: {' '.join(str(error).split())}"
            remedy = "give the method, the options and the version of aenerf-ns that it was made with, or train again"
            raise DataError(str(self.config.load_checkpoint), problem, remedy) from error
        if not self.config.load_scheduler:
            # The optimizers have loaded the last rates of the old schedule.
            for name, schedule in self.optimizers.schedulers.items():
                (group,), (rate,) = self.optimizers.optimizers[name].param_groups, schedule.get_last_lr()
                group["lr"] = rate

    def train(self) -> None:
        """Train the model, and record how far that came."""
        with _full_disk_as_one_line(self.base_dir), self._stopping_after_a_step():
            try:
                super().train()
            except BaseException:
                if self._record is not None:
                    # Nerfstudio counts from 0 until it takes the first step of a run that goes on.
                    self._record.write("stopped", max(self.step - self._steps.start, 0))
                raise

    @contextmanager
    def _stopping_after_a_step(self) -> Iterator[None]:
        """Let the first interrupt, by the keyboard or by SIGTERM, take effect when a step is complete."""
        # Of several processes, Nerfstudio's launcher terminates all at once.
        if self.world_size > 1 or threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, _: object) -> None:
            if self._record is None or self._stopped_by:
                # The training is complete, and the user ends its viewer. Or the user does not want to wait.
                raise SystemExit(128 + number if self._stopped_by else 0)
            self._stopped_by = number
            print("Stopping after this step. Once more stops at once, without a checkpoint.", flush=True)
            # A training that the viewer paused takes no further step by itself.
            self.training_state = "training"

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop_if_asked(self, step: int) -> None:
        # A checkpoint needs a step. A training that is complete ends by itself.
        if self._stopped_by and self._record is not None and step > self._steps.start:
            # The checkpoint is of the last step, and not of the step that comes.
            self.step = step = step - 1
            self.pipeline.color_fit.fit()
            self.save_checkpoint(step)
            self._record.write("stopped", step + 1 - self._steps.start)
            self._record = None
            options = (
                f"--load-dir {shlex.quote(str(self.base_dir))} --load-step {step} "
                f"--max-num-iterations {framework.iterations_to_reach(self._steps.stop, step)}"
            )
            if not self.config.load_scheduler:
                # The schedule that began with this piece goes on.
                options += " --load-scheduler True"
            print(
                f"Stopped after step {step}. Go on with the same command, and {options} after the method's name, in "
                "place of these options where it has them",
                flush=True,
            )
            raise SystemExit(128 + self._stopped_by)

    def _record_end(self, step: int) -> None:
        # Once: the user ends the viewer of a finished training by an interrupt.
        record, self._record = self._record, None
        assert record is not None
        count = step + 1 - self._steps.start
        record.write("finished" if count == len(self._steps) else "stopped", count)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save a checkpoint after a step, whole or not at all. Those of earlier steps are removed after that."""
        contents = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {name: schedule.state_dict() for name, schedule in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
        # Commands of Nerfstudio take every file in the folder for a checkpoint.
        partial = self.base_dir / "checkpoint.partial"
        with _one_line_if_not_written(self.checkpoint_dir / f"step-{step:09d}.ckpt") as path:
            with atomic_write(path, partial):
                torch.save(contents, partial)
            if self.config.save_only_latest_checkpoint:
                # Those of later steps are of another training.
                for other in newest_first(self.checkpoint_dir):
                    if step_of(other) < step:
                        other.unlink()


@contextmanager
def _one_line_if_not_written(path: Path) -> Iterator[Path]:
    """Yield a path to write to, and end the process with one line if that fails."""
    try:
        yield path
    except (OSError, RuntimeError) as error:
        # torch's writer raises RuntimeError for a full disk, and CUDA for faults of the GPU.
        if "CUDA" in str(error):
            raise
        raise _not_written(path, error) from None


@contextmanager
def _interrupt_as_exit_status(world_size: int) -> Iterator[None]:
    """Turn Ctrl-C into one line and its exit status. Nerfstudio's launcher makes a traceback and success of it."""
    try:
        yield
    except KeyboardInterrupt:
        # Of several processes, the launcher terminates all at once.
        if world_size > 1:
            raise
        print("Stopped.", flush=True)
        raise SystemExit(128 + signal.SIGINT) from None


@contextmanager
def _missing_key_as_one_line(vis: str) -> Iterator[None]:
    """Turn the error of wandb or comet for a user who is not logged in into a DataError."""
    try:
        yield
    except Exception as error:
        if isinstance(error, DataError) or "API key" not in str(error):
            raise
        remedy = "log in there, or choose another --vis, such as viewer or tensorboard"
        raise DataError(f"--vis {vis}", str(error).strip().rstrip("."), remedy) from None


@contextmanager
def _full_disk_as_one_line(folder: Path) -> Iterator[None]:
    """Turn the error of a full disk into one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise _not_written(error.filename or folder, error) from None


def _not_written(path: str | Path, error: OSError | RuntimeError) -> SystemExit:
    problem = error.strerror if isinstance(error, OSError) else None
    if problem is None:
        # The message of torch's writer says nothing of the disk.
        free = shutil.disk_usage(Path(path).parents[1]).free
        problem = f"{str(error).splitlines()[0]}; {free / 1e6:.1f} MB are free"
    remedy = "make room or choose another --output-dir, then resume with --load-dir <run>"
    return SystemExit(f"Error: {path}: it cannot be written ({problem}), training stopped; {remedy}")
