"""Reading with little memory, and without the rights of root."""

import codecs
import os
import resource
import time
import zlib
from collections.abc import Callable
from pathlib import Path

from aenerf_ns.errors import DataError

# A refusal may take this much memory, beyond what the process has, and this much CPU time. On a slow machine it may
# take as long as the machine needs to unpack the last number of bytes, because seconds alone would measure the machine.
MAX_BYTES, MAX_SECONDS, _MAX_UNPACKED = 1 << 30, 2.0, 2 << 30

# h5py looks this codec up. Where others than root may not read the interpreter's files, a look-up without the rights of
# root fails, and Python remembers that there is no such codec.
codecs.lookup("ascii")


def refusal(read: Callable[[], object], max_seconds: float = MAX_SECONDS) -> str:
    """Read in little memory and time, and return the line of the error, or nothing where there is none."""
    begin, message = time.process_time(), ""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    user, before = os.geteuid(), resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + MAX_BYTES, before[1]))
    try:
        if user == 0:
            # Root may read everything.
            os.seteuid(65534)
        read()
    except DataError as error:
        message = str(error)
    finally:
        os.seteuid(user)
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert len(message) < 800
    seconds = time.process_time() - begin
    assert seconds < max_seconds or seconds < _seconds_to_unpack(_MAX_UNPACKED)
    return message


def _seconds_to_unpack(size: int) -> float:
    """Measure the CPU time in which this machine unpacks as many bytes, by an eighth of them."""
    packed = zlib.compress(bytes(size // 8))
    begin = time.process_time()
    zlib.decompress(packed)
    return 8 * (time.process_time() - begin)
