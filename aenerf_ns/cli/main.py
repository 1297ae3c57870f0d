"""The ``aenerf`` command: simulate, convert, check and reconstruct datasets, evaluate and export trained runs."""

from __future__ import annotations

import sys

import tyro

from aenerf_ns.cli.first_look import judge_paths
from aenerf_ns.errors import DataError


def main() -> None:
    """Run the ``aenerf`` command.

    Bad input ends the process with one line and exit status 1, bad arguments with exit status 2.
    """
    try:
        judge_paths(sys.argv[1:])
    except DataError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2 if sys.argv[1] == "check" else 1)
    # Not before, because these imports take a quarter of a minute.
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

    try:
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
            description="AE-NeRF tools; train with ns-train aenerf.",
        )
    except DataError as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        command.main()
    except DataError as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    main()
