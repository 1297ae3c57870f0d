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

# Path.home() raises for a user without a home.
if not any(os.access(place, os.W_OK) for place in (os.path.dirname(__file__), os.path.expanduser("~"))):
    # numba keeps what it compiles beside the package or in the home, and raises where it can write neither.
    os.environ.setdefault("NUMBA_CACHE_DIR", f"{tempfile.gettempdir()}/aenerf-ns-numba-{os.getuid()}")
