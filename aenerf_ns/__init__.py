"""AE-NeRF: neural radiance fields from an event camera, as a Nerfstudio method.

Importing this package must stay cheap and must not fail: every ``ns-*`` command imports it to discover the method,
also for users who run another method. Import what you need from its modules.
"""

__version__ = "0.2.0"
