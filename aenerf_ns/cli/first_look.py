"""Parse and judge a command line before the import of torch and the framework, which takes seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import tyro

from aenerf_ns.cli.arguments import (
    FORMAT_NAMES,
    CheckArguments,
    ConvertArguments,
    EvaluateArguments,
    ExportTrajectoryArguments,
    Named,
    ReconstructArguments,
    SimulateArguments,
)
from aenerf_ns.cli.export_arguments import (
    ExportCamerasArguments,
    ExportFramesArguments,
    ExportMeshArguments,
    ExportVideoArguments,
    ReportArguments,
)
from aenerf_ns.cli.run_file import require_plausible
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_dataset

OfDataset = CheckArguments | ConvertArguments | ReconstructArguments
OfRun = (
    EvaluateArguments
    | ExportTrajectoryArguments
    | ExportCamerasArguments
    | ExportFramesArguments
    | ExportMeshArguments
    | ExportVideoArguments
)
Arguments = SimulateArguments | OfDataset | OfRun | ReportArguments

DESCRIPTION = "AE-NeRF tools; train with ns-train aenerf."
_COMMANDS: dict[str, Callable[..., Arguments]] = {
    "simulate": SimulateArguments,
    "convert": ConvertArguments,
    "check": CheckArguments,
    "reconstruct": ReconstructArguments,
    "evaluate": EvaluateArguments,
    "report": ReportArguments,
    "export-trajectory": ExportTrajectoryArguments,
    "export-cameras": ExportCamerasArguments,
    "export-frames": ExportFramesArguments,
    "export-mesh": ExportMeshArguments,
    "export-video": ExportVideoArguments,
}
_FORMATS = {"auto", *FORMAT_NAMES}


def parsed(words: Sequence[str]) -> Arguments | None:
    """Parse the words after ``aenerf``, without the options of a format, which come with the framework.

    Returns:
        The arguments, or None where only the options of a format can tell what the words mean.

    Raises:
        DataError: nothing to work on is given, or it is given twice.
        SystemExit: help is asked for, or the words cannot be parsed. Both are printed.
    """
    before = _before_format(words)
    if before is None:
        return _parsed(words)
    if {"-h", "--help"} & set(words):
        return None
    try:
        arguments = _parsed(before, console_outputs=False)
    except (SystemExit, DataError):
        return None
    assert isinstance(arguments, OfDataset)
    arguments.format = Named()
    return arguments


def judge(arguments: Arguments) -> None:
    """Judge arguments, and the dataset or the run that they name.

    Raises:
        DataError: an argument is impossible, or a file or folder is missing, in the way or malformed.
    """
    arguments.judge()
    if isinstance(arguments, OfDataset):
        require_dataset(arguments.data)
    elif isinstance(arguments, OfRun):
        require_plausible(arguments.load_config)
    elif isinstance(arguments, ReportArguments):
        for run in arguments.runs:
            require_plausible(run)


def _parsed(words: Sequence[str], console_outputs: bool = True) -> Arguments:
    return tyro.extras.subcommand_cli_from_dict(
        _COMMANDS, prog="aenerf", description=DESCRIPTION, args=words, console_outputs=console_outputs
    )


def _before_format(words: Sequence[str]) -> Sequence[str] | None:
    """Return the words before the name of a format, or None if they name none."""
    if not words or words[0] not in ("convert", "check", "reconstruct") or not _FORMATS & set(words):
        return None
    for index in range(1, len(words)):
        # After an option, the word may be its value.
        if words[index] in _FORMATS and (words[index - 1][:1] != "-" or "=" in words[index - 1]):
            return words[:index]
    return []
