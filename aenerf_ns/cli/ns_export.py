"""``python -m aenerf_ns.cli.ns_export``: ``ns-export``, on machines without the libusb that Open3D needs as well.

``ns-export`` imports Open3D before it loads plugins, so a plugin cannot help it.
"""

from __future__ import annotations

import sys

from aenerf_ns.errors import errors_as_one_line
from aenerf_ns.open3d_import import load_open3d


def main() -> None:
    """Run ``ns-export`` with the arguments of the process."""
    with errors_as_one_line():
        load_open3d()
    from nerfstudio.scripts import exporter

    # A run's configuration knows by the name of the command that the run is opened, and then finds its folder.
    sys.argv[0] = "ns-export"
    exporter.entrypoint()


if __name__ == "__main__":
    main()
