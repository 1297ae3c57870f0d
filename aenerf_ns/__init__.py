"""AE-NeRF: neural radiance fields from an event camera, as a Nerfstudio method.

Importing this package must stay cheap and must not fail: every ``ns-*`` command imports it to discover the method,
also for users who run another method. Import what you need from its modules.
"""

import os
import stat
import tempfile
import warnings
from contextlib import suppress

__version__ = "0.2.0"

# They say nothing that a user could change. The second is of Nerfstudio's cameras, under recent versions of torch.
warnings.filterwarnings("ignore", r"`torch\.(jit\.script|cuda\.amp)", FutureWarning)
warnings.filterwarnings("ignore", "Using a non-tuple sequence", UserWarning)


def _is_writable(folder: str) -> bool:
    """Return whether a folder that may not exist yet can be made and written to."""
    while not os.path.exists(folder):
        folder = os.path.dirname(folder)
    return os.access(folder, os.W_OK)


def _temporary_cache() -> str:
    """Return a folder that only this user can write to, because numba runs what it finds there."""
    folder = f"{tempfile.gettempdir()}/aenerf-ns-numba-{os.getuid()}"
    with suppress(FileExistsError):
        os.mkdir(folder, 0o700)
    found = os.lstat(folder)
    is_own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if is_own else tempfile.mkdtemp(prefix="aenerf-ns-numba-")


# numba keeps what it compiles in one of these, and raises where it can write neither. Path.home() raises for a user
# without a home.
_NUMBA_CACHES = (
    os.path.join(os.path.dirname(__file__), "__pycache__"),
    os.path.abspath(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) + "/numba",
)
if "NUMBA_CACHE_DIR" not in os.environ and not any(map(_is_writable, _NUMBA_CACHES)):
    os.environ["NUMBA_CACHE_DIR"] = _temporary_cache()
