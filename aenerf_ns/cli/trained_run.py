"""How the commands open a trained run: not before its configuration is known to name nothing foreign."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from aenerf_ns.cli.run_file import require_known_tags
from aenerf_ns.errors import DataError
from aenerf_ns.files.given_paths import require_run

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.training.pipeline import AENeRFPipeline


def open_run(run: Path, test_mode: Literal["test", "inference"] = "test") -> tuple[TrainerConfig, AENeRFPipeline, Path]:
    """Open a trained run.

    Args:
        run: the run's config.yml, or its folder.
        test_mode: see :class:`~aenerf_ns.training.pipeline.AENeRFPipeline`.

    Returns:
        The run's configuration, its pipeline, and the checkpoint that was loaded.

    Raises:
        DataError: there is no such file, opening it could run foreign code, or the run is of another method.
    """
    config = require_run(run)
    require_known_tags(config)
    # Imported lazily, because these imports take seconds.
    from nerfstudio.utils.eval_utils import eval_setup

    from aenerf_ns.training.pipeline import AENeRFPipeline

    opened, pipeline, checkpoint, _ = eval_setup(config, test_mode=test_mode)
    if not isinstance(pipeline, AENeRFPipeline):
        raise DataError(config, f"the run is of method {opened.method_name}", "use ns-eval and ns-export")
    return opened, pipeline, checkpoint
