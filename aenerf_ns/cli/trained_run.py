"""How the commands open a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from aenerf_ns.cli.config_safety import require_known_names
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_run

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.evaluation.run import TrainedRun


RunPath = Annotated[
    Path,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="RUN", help="The run: its config.yml, or its folder. --load-config RUN works too."),
]
"""The run that a command works on."""


def open_run(run: Path, test_mode: Literal["test", "inference"] = "test") -> tuple[TrainerConfig, TrainedRun, Path]:
    """Open a trained run.

    Args:
        run: the run's config.yml, or its folder.
        test_mode: see :class:`~aenerf_ns.training.pipeline.AENeRFPipeline`.

    Returns:
        The run's configuration, the run, and the checkpoint that was loaded.

    Raises:
        DataError: there is no such file, opening it could run foreign code, the run is of another method, it has no
            whole checkpoint, or a value in its files is impossible.
    """
    config = require_run(run)
    require_known_names(config)
    from nerfstudio.utils.eval_utils import eval_setup

    from aenerf_ns.training.pipeline import AENeRFPipeline

    try:
        opened, pipeline, checkpoint, _ = eval_setup(
            config, test_mode=test_mode, update_config_callback=_require_checkpoints
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
            raise DataError(
                checkpoint, f"its {name} is not finite", "remove it if there is an earlier one, or train again"
            )
    return opened, pipeline.trained_run(), checkpoint


def _require_checkpoints(config: TrainerConfig) -> TrainerConfig:
    """Raise a DataError for a run without checkpoints, of which the framework complains in several lines."""
    folder = config.get_checkpoint_dir()
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder", "copy the run's checkpoints, or train again")
    return config
