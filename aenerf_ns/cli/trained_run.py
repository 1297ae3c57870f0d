"""How the commands open a trained run: not before its configuration is known to name nothing foreign."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from aenerf_ns.cli.run_file import require_known_tags
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_run

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.evaluation.run import TrainedRun


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
    require_known_tags(config)
    # Imported lazily, because these imports take seconds.
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
        told = f"{type(error).__name__}: {' '.join(str(error).split())}"
        remedy = "copy the run again, or train again; ns-eval --load-config shows the traceback"
        raise DataError(config, f"the run cannot be opened ({told})", remedy) from error
    if not isinstance(pipeline, AENeRFPipeline):
        raise DataError(config, f"the run is of method {opened.method_name}", "use ns-eval and ns-export")
    for name, value in pipeline.named_parameters():
        if not value.isfinite().all():
            raise DataError(
                checkpoint, f"its {name} is not finite", "remove it if there is an earlier one, or train again"
            )
    return opened, pipeline.trained_run(), checkpoint


def _require_checkpoints(config: TrainerConfig) -> TrainerConfig:
    """Raise a DataError for a run without checkpoints, which the framework tells in several lines."""
    folder = config.get_checkpoint_dir()
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder", "copy the run's checkpoints, or train again")
    return config
