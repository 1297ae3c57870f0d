"""What several tests share."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from aenerf_ns.camera.rotation import rotation_from_vector
from aenerf_ns.events.stream import EventStream

# For the package `benchmarks`, which is not installed. At the end, because the repository's own `aenerf_ns` lacks two
# folders of the installed one.
sys.path.append(str(Path(__file__).parents[1]))

if not torch.cuda.is_available():
    # Before anything imports Triton: it then interprets its kernels on the CPU.
    os.environ["TRITON_INTERPRET"] = "1"

# Examples of each test that feeds readers with damaged and random input; many more when they are set to.
FUZZ_EXAMPLES = int(os.environ.get("AENERF_FUZZ_EXAMPLES", "60"))

# Third-party recordings, which are not part of the project.
_SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def slider_depth() -> Path:
    """The real recording slider_depth of the Event Camera Dataset (its first 50,000 events)."""
    folder = _SHARED_DATA / "slider_depth"
    if not folder.is_dir():
        pytest.skip("the recording slider_depth of the Event Camera Dataset is not at ../shared/data/slider_depth")
    return folder


@pytest.fixture(scope="session")
def tum_vie_calibration() -> Path:
    """The folder of the real calibration files of TUM-VIE."""
    folder = _SHARED_DATA / "tum_vie_calibration"
    if not folder.is_dir():
        pytest.skip("the calibration files of TUM-VIE are not at ../shared/data/tum_vie_calibration")
    return folder


@pytest.fixture
def random_poses() -> torch.Tensor:
    """(8, 3, 4) float64 random camera-to-world poses with rotations up to 2.5 rad."""
    generator = torch.Generator().manual_seed(0)
    vectors = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    vectors *= 2.5 / vectors.norm(dim=-1).max()
    positions = torch.randn(8, 3, 1, generator=generator, dtype=torch.float64)
    return torch.cat([rotation_from_vector(vectors), positions], -1)


def make_stream(rows: list[tuple[int, int, int, int]], width: int = 4, height: int = 3) -> EventStream:
    """A stream of (x, y, t, p) rows."""
    x, y, t, p = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventStream(
        x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.int8), width, height, "made"
    )
