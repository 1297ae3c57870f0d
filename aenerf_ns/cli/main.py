"""The ``aenerf`` command: simulate, convert, check and reconstruct datasets, evaluate and export trained runs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import tyro

from aenerf_ns.cli import first_look
from aenerf_ns.errors import DataError


def main() -> None:
    """Run the ``aenerf`` command.

    Bad input ends the process with one line and exit status 1, bad arguments with exit status 2.
    """
    words = sys.argv[1:]
    with _error_as_status(2):
        arguments = first_look.parsed(words)
    if arguments is not None:
        with _error_as_status(2 if words[0] == "check" else 1):
            first_look.judge(arguments)
    # Not before, because these imports take seconds.
    from aenerf_ns.cli.check import Check
    from aenerf_ns.cli.convert import Convert
    from aenerf_ns.cli.evaluate import Evaluate
    from aenerf_ns.cli.export_cameras import ExportCameras
    from aenerf_ns.cli.export_frames import ExportFrames
    from aenerf_ns.cli.export_mesh import ExportMesh
    from aenerf_ns.cli.export_trajectory import ExportTrajectory
    from aenerf_ns.cli.export_video import ExportVideo
    from aenerf_ns.cli.reconstruct import Reconstruct
    from aenerf_ns.cli.report import Report
    from aenerf_ns.cli.simulate import Simulate

    with _error_as_status(2):
        command = tyro.extras.subcommand_cli_from_dict(
            {
                "simulate": Simulate,
                "convert": Convert,
                "check": Check,
                "reconstruct": Reconstruct,
                "evaluate": Evaluate,
                "report": Report,
                "export-trajectory": ExportTrajectory,
                "export-cameras": ExportCameras,
                "export-frames": ExportFrames,
                "export-mesh": ExportMesh,
                "export-video": ExportVideo,
            },
            prog="aenerf",
            description=first_look.DESCRIPTION,
        )
    with _error_as_status(1):
        command.main()


@contextmanager
def _error_as_status(status: int) -> Iterator[None]:
    """End the process with one line and a status in place of a DataError."""
    try:
        yield
    except DataError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(status)


if __name__ == "__main__":
    main()
