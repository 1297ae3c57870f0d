"""AE-NeRF: neural radiance fields from an event camera, as a Nerfstudio method.

Importing this package must stay cheap and must not fail: every ``ns-*`` command imports it to discover the method,
also for users who run another method. Import what you need from its modules.
"""

import os
import tempfile
import warnings

__version__ = "0.2.0"

# They say nothing that a user could change.
warnings.filterwarnings("ignore", r"(?s).*TBB threading layer")
warnings.filterwarnings("ignore", r"`torch\.(jit\.script|cuda\.amp)", FutureWarning)


def _is_writable(folder: str) -> bool:
    """Return whether a folder that may not exist yet can be made and written to."""
    while not os.path.exists(folder):
        folder = os.path.dirname(folder)
    return os.access(folder, os.W_OK)


# numba keeps what it compiles in one of these, and raises where it can write neither. Path.home() raises for a user
# without a home.
_NUMBA_CACHES = (
    os.path.join(os.path.dirname(__file__), "__pycache__"),
    os.path.abspath(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) + "/numba",
)
if not any(map(_is_writable, _NUMBA_CACHES)):
    os.environ.setdefault("NUMBA_CACHE_DIR", f"{tempfile.gettempdir()}/aenerf-ns-numba-{os.getuid()}")
