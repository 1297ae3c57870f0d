"""``ns-export`` on a machine whose system lacks what Open3D needs."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_the_exporter_starts_where_the_system_has_no_libusb() -> None:
    # Where the system has it, this shows only that the exporter takes its arguments.
    command = [sys.executable, "-m", "aenerf_ns.cli.export", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "{pointcloud," in done.stdout
