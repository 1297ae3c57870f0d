"""Import Open3D, which needs a system library that it does not bring."""

from __future__ import annotations

import ctypes
import sys
from types import ModuleType

from aenerf_ns.errors import DataError


def load_open3d() -> ModuleType:
    """Import Open3D and the libusb that it needs. Call this late, because the import takes seconds.

    Raises:
        DataError: a system library that Open3D needs is missing.
    """
    if sys.platform == "linux":
        # Open3D's wheels link libusb, for depth cameras, but do not contain it.
        try:
            ctypes.CDLL("libusb-1.0.so.0")
        except OSError:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()))
    try:
        import open3d
    except (ImportError, OSError) as error:
        remedy = (
            "install the missing libraries, on Debian and Ubuntu: apt-get install libgl1 libx11-6 libgomp1 libusb-1.0-0"
        )
        raise DataError("Open3D", f"cannot be loaded ({error})", remedy) from error
    return open3d
