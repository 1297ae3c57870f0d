"""How the commands open a trained run: not before its configuration is known to name nothing foreign.

``config.yml`` is opened by a loader of YAML that makes any object and calls any function that the file names.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from aenerf_ns.errors import DataError
from aenerf_ns.files.given_paths import require_run

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.training.pipeline import AENeRFPipeline

_YAML = "tag:yaml.org,2002:"
_PLAIN = {
    f"{_YAML}{name}"
    for name in ("null", "bool", "int", "float", "str", "seq", "map", "python/tuple", "python/list", "python/dict")
}
# Whose classes a configuration is made of.
_PACKAGES = ("nerfstudio.", "torch.optim.", "aenerf_ns.")
# The framework's configurations name these classes and functions, too.
_PATHS = {f"pathlib.{name}" for name in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath", "Path")}
_FUNCTIONS = {"nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate"}


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


def require_known_tags(config: Path) -> None:
    """Raise a DataError unless all that a config.yml names is of the framework, torch's optimizers or this package.

    A name must be of a class. Nothing is called but paths and enumerations. So no function of these packages runs
    because the file says so.
    """
    remedy = "give the config.yml of a trained run, and only one that you trust"
    try:
        tags = [
            (event.tag, event.start_mark.line + 1)
            for event in yaml.parse(config.read_text("utf8"), Loader=yaml.Loader)
            if getattr(event, "tag", None) is not None
        ]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise DataError(config, f"it cannot be read ({error})", remedy) from None
    for tag, line in tags:
        if not _is_known(tag):
            named = tag.removeprefix(_YAML)
            kind, _, name = named.partition(":")
            if kind in ("python/object", "python/name") and name.startswith("aenerf_ns.") and _find(name) is None:
                raise DataError(
                    config, f"line {line} names {name}, not of this version", "open it with the version that trained it"
                )
            raise DataError(config, f"line {line} names {named}, and opening the file could run it", remedy)
    if not tags or not tags[0][0].startswith(f"{_YAML}python/object:"):
        raise DataError(config, "it is no configuration of a run", remedy)


def _is_known(tag: str) -> bool:
    """Return whether a tag makes nothing but plain values and objects of known classes."""
    if tag in _PLAIN:
        return True
    kind, _, name = tag.removeprefix(_YAML).partition(":")
    if kind == "python/object/apply" and name in _PATHS:
        return True
    if not name.startswith(_PACKAGES):
        return False
    if kind == "python/name" and name in _FUNCTIONS:
        return True
    found = _find(name)
    # A module of a known package may have imported a class of another one.
    if not isinstance(found, type) or not f"{found.__module__}.".startswith(_PACKAGES):
        return False
    return (
        kind == "python/name"
        or (kind == "python/object" and dataclasses.is_dataclass(found))
        or (kind == "python/object/apply" and issubclass(found, enum.Enum))
    )


def _find(name: str) -> Any:
    """Return what a dotted name of a known package stands for, or None."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute, None)
    except ImportError:
        return None
