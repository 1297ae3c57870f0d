"""The ``aenerf`` command: simulate, convert, check and reconstruct datasets, evaluate and export trained runs."""

from __future__ import annotations

import importlib
import io
import signal
import sys
from collections.abc import Sequence
from typing import Any

from aenerf_ns.errors import DataError

COMMANDS = {
    "simulate": "simulate:Simulate",
    "simulate-video": "simulate_video:SimulateVideo",
    "convert": "convert:Convert",
    "check": "check:Check",
    "reconstruct": "reconstruct:Reconstruct",
    "evaluate": "evaluate:Evaluate",
    "report": "report:ReportCommand",
    "export-trajectory": "export:ExportTrajectory",
    "export-cameras": "export:ExportCameras",
    "export-frames": "export:ExportFrames",
    "export-mesh": "export:ExportMesh",
    "export-video": "export:ExportVideo",
}
"""Modules and classes of the commands by name. Only the chosen one is imported."""
_POSITIONAL = ("--video", "--load-config")
# Of these commands the dataset is the positional argument. Others take it as an option.
_OF_DATASETS = ("convert", "check", "reconstruct")


def main() -> None:
    """Run the ``aenerf`` command.

    Bad arguments end the process with exit status 2, bad data with one line and exit status 1, or 2 for ``check``.
    """
    for stream in (sys.stdout, sys.stderr):
        # A terminal without UTF-8 shows question marks.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    words = _with_positional_first(sys.argv[1:])
    names = words[:1] if words and words[0] in COMMANDS else COMMANDS
    command = None
    try:
        # Imported here, so that Ctrl-C while it is imported is one line, too.
        import tyro

        commands: dict[str, Any] = {name: load_command(name) for name in names}
        description = "AE-NeRF tools; train with ns-train aenerf."
        command = tyro.extras.subcommand_cli_from_dict(commands, prog="aenerf", description=description, args=words)
        command.main()
    except DataError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(getattr(command, "error_status", 1))
    except BaseException as error:
        if not _is_interrupt(error):
            raise
        print("Stopped.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error. Libraries that are being imported make other errors of it."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _is_interrupt(error.__cause__ or error.__context__)
    )


def load_command(name: str) -> type[Any]:
    """Import the class of a command."""
    module, _, attribute = COMMANDS[name].partition(":")
    return getattr(importlib.import_module(f"aenerf_ns.cli.{module}"), attribute)


def _with_positional_first(words: Sequence[str]) -> Sequence[str]:
    """Turn ``--data DATA``, as users of ns-train type it, into the positional argument after the command's name."""
    for index, word in enumerate(words):
        option, equals, value = word.partition("=")
        names = (*_POSITIONAL, "--data") if words[0] in _OF_DATASETS else _POSITIONAL
        if index > 0 and option.replace("_", "-") in names:
            rest = words[index + 1 :] if equals else words[index + 2 :]
            given = [value] if equals else words[index + 1 : index + 2]
            return [words[0], *given, *words[1:index], *rest]
    return words


if __name__ == "__main__":
    main()
