"""How the commands open a trained run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from aenerf_ns.cli.config_safety import require_known_names
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_dataset, require_run

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.evaluation.run import TrainedRun


@dataclass
class RunCommand:
    """A command that works on a trained run."""

    load_config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run: its config.yml, or its folder. --load-config RUN works too."""
    data: Path | None = field(default=None, kw_only=True)
    """Where the dataset of the run is now, if it was moved."""


def open_run(
    run: Path, data: Path | None = None, test_mode: Literal["test", "inference"] = "test"
) -> tuple[TrainerConfig, TrainedRun, Path]:
    """Open a trained run.

    Args:
        run: the run's config.yml, or its folder. Its checkpoints are beside it.
        data: where its dataset is now, or None where it was trained.
        test_mode: see :class:`~aenerf_ns.training.pipeline.AENeRFPipeline`.

    Returns:
        The run's configuration, with the steps that were made as its number of iterations, the run, and the checkpoint
        that was loaded.

    Raises:
        DataError: there is no such file, opening it could run foreign code, the run is of another method, it has no
            whole checkpoint, or a value in its files is impossible.
    """
    config = require_run(run)
    require_known_names(config)
    from nerfstudio.utils.eval_utils import eval_setup

    from aenerf_ns.training.checkpoints import step_of
    from aenerf_ns.training.pipeline import AENeRFPipeline

    try:
        opened, pipeline, checkpoint, _ = eval_setup(
            config, test_mode=test_mode, update_config_callback=lambda saved: _at_its_place(saved, config, data)
        )
    except DataError:
        raise
    except Exception as error:
        # The framework and torch stumble over values of a wrong kind in any way.
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        remedy = "copy the run again, or train again; ns-eval --load-config shows the traceback"
        raise DataError(config, f"the run cannot be opened ({reason})", remedy) from error
    if not isinstance(pipeline, AENeRFPipeline):
        raise DataError(config, f"the run is of method {opened.method_name}", "use ns-eval and ns-export")
    for name, value in pipeline.named_parameters():
        if not value.isfinite().all():
            problem = f"its {name} is not finite"
            raise DataError(checkpoint, problem, "move it away if there is an earlier one, or train again")
    # A run that was stopped, or that goes on, has made other steps than it planned.
    opened.max_num_iterations = step_of(checkpoint) + 1
    return opened, pipeline.trained_run(), checkpoint


def _at_its_place(config: TrainerConfig, path: Path, data: Path | None) -> TrainerConfig:
    """Tell a configuration where its file and its dataset are now.

    Raises:
        DataError: there are no checkpoints. The framework would print several lines.
    """
    config.__dict__["opened_folder"] = path.absolute().parent
    folder = config.get_checkpoint_dir()
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder", "copy it from the run, beside its config.yml")
    dataparser = getattr(config.pipeline.datamanager, "dataparser", None)
    if dataparser is None:
        return config
    before = Path(dataparser.data)
    config.__dict__["data_at_training"] = before.absolute()
    # A run opens without its events, also where their file stands for the recording.
    if data is None and not before.exists() and getattr(dataparser, "events", None) != before:
        raise DataError(before, "the dataset of the run is not there", "say where it is now with --data")
    if data is not None:
        require_dataset(data)
        # It would take the place of the dataparser's.
        config.pipeline.datamanager.data = None
        # Where the event file stands for the recording, the files beside the event file are parts of the recording.
        old, new = (path.parent if data.is_file() else path for path in (before, data.absolute()))
        for option, value in list(vars(dataparser).items()):
            if value == before:
                setattr(dataparser, option, data.absolute())
            elif isinstance(value, Path) and value.is_relative_to(old):
                setattr(dataparser, option, new / value.relative_to(old))
    return config
