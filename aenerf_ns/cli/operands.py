"""The dataset or the run that a command works on: given as a word of its own, or with an option."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from aenerf_ns.errors import DataError


def _one_of(word: Path | None, named: Path | None, option: str) -> Path:
    """Return the path that is given.

    Raises:
        DataError: no path is given, or both are.
    """
    if word is not None and named is not None:
        raise DataError(word, f"{option} {named} is given as well", "leave out one of the two")
    given = named if word is None else word
    if given is None:
        raise DataError("aenerf", "nothing to work on is given", f"name it after the command, or with {option}")
    return given


def _dataset(
    word: Annotated[
        Path | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="DATA", help="The dataset.", help_behavior_hint="(required, here or with --data)"),
    ] = None,
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="DATA", help="Another way to give the dataset.", help_behavior_hint="")
    ] = None,
) -> Path:
    return _one_of(word, data, "--data")


def _run(
    word: Annotated[
        Path | None,
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar="RUN",
            help="The run: its config.yml, or its folder.",
            help_behavior_hint="(required, here or with --load-config)",
        ),
    ] = None,
    load_config: Annotated[
        Path | None,
        tyro.conf.arg(metavar="RUN", help="Another way to give the run.", help_behavior_hint=""),
    ] = None,
) -> Path:
    return _one_of(word, load_config, "--load-config")


# Options of a format follow the format's name. CascadeSubcommandArgs accepts the dataset there too.
Dataset = Annotated[Path, tyro.conf.arg(constructor=_dataset, name=""), tyro.conf.CascadeSubcommandArgs]
"""A dataset: ``DATA`` or ``--data DATA``."""

RunConfig = Annotated[Path, tyro.conf.arg(constructor=_run, name="")]
"""A trained run, by its config.yml or its folder: ``RUN`` or ``--load-config RUN``."""
