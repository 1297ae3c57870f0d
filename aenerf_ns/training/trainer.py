"""Nerfstudio's trainer, with schedules of the run's length, whole checkpoints, and a record of the run."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import yaml
from nerfstudio.engine.trainer import Trainer, TrainerConfig, writer
from nerfstudio.utils import comms
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.errors import DataError, errors_as_one_line
from aenerf_ns.training.checkpoints import checkpoint_to_load, move_whole, require_whole, step_of
from aenerf_ns.training.device import require_device
from aenerf_ns.training.run_record import RunRecord, ScalarWriter
from aenerf_ns.training.schedules import RelativeCosineSchedulerConfig, RelativeMultiStepSchedulerConfig


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

    def set_timestamp(self) -> None:
        """Set the time that names the run. It is the first step of ns-train, which so far has written nothing.

        Raises:
            SystemExit: a GPU is asked for, and there is none.
        """
        require_device(self.machine.device_type)
        super().set_timestamp()

    def get_checkpoint_dir(self) -> Path:
        """Return the folder of the run's checkpoints, and let the commands that open a run load the newest whole one.

        They ask for the folder and then load the checkpoint of ``load_step``, or otherwise the last one, broken or not.

        Raises:
            SystemExit: the folder exists without a whole checkpoint.
        """
        folder = super().get_checkpoint_dir()
        self.load_step = None
        if folder.exists():
            with errors_as_one_line():
                self.load_step = step_of(checkpoint_to_load(folder))
        return folder

    def save_config(self) -> None:
        """Save the configuration to the run's folder, whole or not at all.

        Raises:
            SystemExit: the file cannot be written.
        """
        path = self.get_base_dir() / "config.yml"
        CONSOLE.log(f"Saving config to: {path}")
        partial = path.with_name("config.yml.partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(yaml.dump(self), "utf8")
            move_whole(partial, path)
        except OSError as error:
            with suppress(OSError):
                partial.unlink()
            raise SystemExit(_cannot_be_written(path, error)) from None


def _require_work(config: TrainerConfig) -> None:
    """Raise a DataError for a training of no steps, or of steps without rays."""
    numbers = {
        "max-num-iterations": config.max_num_iterations,
        "pipeline.datamanager.train-num-rays-per-batch": config.pipeline.datamanager.train_num_rays_per_batch,
    }
    for name, value in numbers.items():
        if value < 1:
            raise DataError("ns-train", f"--{name} {value}", "give one or more")


class AENeRFTrainer(Trainer):
    """Trainer that saves checkpoints whole or not at all, and goes on from whole ones.

    Raises:
        SystemExit: with one clear line, when the checkpoint to go on from cannot be loaded or the disk is full.
    """

    config: AENeRFTrainerConfig
    checkpoint_dir: Path

    def __init__(self, config: AENeRFTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        config.schedule_length = config.schedule_length or config.max_num_iterations
        with errors_as_one_line():
            _require_work(config)
            if config.load_dir is not None:
                # As one path, because commands that open the run would look for a load_step among its own checkpoints.
                config.load_checkpoint = checkpoint_to_load(config.load_dir, config.load_step)
                config.load_dir = config.load_step = None
            elif config.load_checkpoint is not None:
                require_whole(config.load_checkpoint)
        self._record: RunRecord | None = None
        self._ends = False
        super().__init__(config, local_rank, world_size)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up the training."""
        with errors_as_one_line(), _full_disk_as_one_line(self.base_dir):
            super().setup(test_mode)
        # The framework counts its percentages and its time left from step 0, also in a run that goes on.
        writer.GLOBAL_BUFFER["max_iter"] = self._start_step + self.config.max_num_iterations
        if comms.is_main_process():
            with _full_disk_as_one_line(self.base_dir):
                writer.EVENT_WRITERS.append(ScalarWriter(self.base_dir))
                self._record = RunRecord(
                    self.base_dir, self.config.machine.seed, self._start_step, self.config.max_num_iterations
                )

    def train(self) -> None:
        """Train the model, and record how far that came."""
        with _full_disk_as_one_line(self.base_dir):
            try:
                super().train()
            except BaseException:
                self._record_end("stopped", self.step - self._start_step)
                raise

    def _after_train(self) -> None:
        # The framework saves the last checkpoint, and then waits for the user to end the viewer.
        self._ends = True
        super()._after_train()

    def _record_end(self, state: str, num_steps: int) -> None:
        # Once: the user ends the viewer of a finished training by an interrupt.
        record, self._record = self._record, None
        if record is not None:
            record.write(state, num_steps)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save a checkpoint whole or not at all. The older ones are removed after that.

        Args:
            step: the last step of training.
        """
        folder = self.checkpoint_dir
        # Beside the folder, because commands of the framework take every file in the folder for a checkpoint.
        partial = folder.with_name(f"{folder.name}.partial")
        path = folder / f"step-{step:09d}.ckpt"
        try:
            shutil.rmtree(partial, ignore_errors=True)
            self.checkpoint_dir = partial
            super().save_checkpoint(step)
            folder.mkdir(parents=True, exist_ok=True)
            move_whole(partial / path.name, path)
        except (OSError, RuntimeError) as error:
            # torch's writer raises RuntimeError for a full disk, and CUDA for faults of the GPU.
            if "CUDA" in str(error):
                raise
            raise SystemExit(_cannot_be_written(path, error)) from None
        finally:
            self.checkpoint_dir = folder
            shutil.rmtree(partial, ignore_errors=True)
        if self.config.save_only_latest_checkpoint:
            for other in folder.glob("*.ckpt"):
                if other != path:
                    other.unlink()
        if self._ends:
            num_steps = self.step + 1 - self._start_step
            self._record_end("finished" if num_steps == self.config.max_num_iterations else "stopped", num_steps)


@contextmanager
def _full_disk_as_one_line(folder: Path) -> Iterator[None]:
    """Turn the error of a full disk into one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise SystemExit(_cannot_be_written(error.filename or folder, error)) from None


def _cannot_be_written(path: str | Path, error: OSError | RuntimeError) -> str:
    reason = error.strerror if isinstance(error, OSError) else None
    if reason is None:
        # The message of torch's writer says nothing of the disk.
        free = shutil.disk_usage(Path(path).parents[1]).free
        reason = f"{str(error).splitlines()[0]}; {free / 1e6:.1f} MB are free"
    return (
        f"Error: {path}: it cannot be written ({reason}), training stopped; make room or choose another --output-dir, "
        "and go on from the last checkpoint or start again"
    )
