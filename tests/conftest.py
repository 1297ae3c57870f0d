"""What several tests share."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from aenerf_ns.camera.rotation import rotation_from_vector

# For the package `benchmarks`, which is not installed. At the end, because the repository's own `aenerf_ns` lacks two
# folders of the installed one.
sys.path.append(str(Path(__file__).parents[1]))

if not torch.cuda.is_available():
    # Before anything imports Triton: it then interprets its kernels on the CPU.
    os.environ["TRITON_INTERPRET"] = "1"

# The same examples in every run of the suite, so that a failure is that of a change. Longer runs look for new ones.
settings.register_profile("suite", derandomize="AENERF_FUZZ_EXAMPLES" not in os.environ)
settings.load_profile("suite")


def _third_party_data(name: str) -> Path:
    """A folder of recordings that are not part of the project. Skips the test where it is missing."""
    folder = Path(__file__).parents[2] / "shared" / "data" / name
    if not folder.is_dir():
        pytest.skip(f"../shared/data/{name} is missing")
    return folder


@pytest.fixture(scope="session")
def slider_depth() -> Path:
    """The real recording slider_depth of the Event Camera Dataset (its first 50,000 events)."""
    return _third_party_data("slider_depth")


@pytest.fixture(scope="session")
def firenet_weights() -> Path:
    """The weights file of FireNet's authors."""
    return _third_party_data("firenet") / "firenet_1000.pth.tar"


@pytest.fixture(scope="session")
def tum_vie_calibration() -> Path:
    """The folder of the real calibration files of TUM-VIE."""
    return _third_party_data("tum_vie_calibration")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for the files of all examples of a module."""
    return tmp_path_factory.mktemp("files")


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """Let a test draw the same numbers in whichever order tests run."""
    torch.manual_seed(0)


@pytest.fixture
def threads() -> Iterator[None]:
    """Lets a test change the number of torch's threads."""
    num_threads = torch.get_num_threads()
    yield
    torch.set_num_threads(num_threads)


@pytest.fixture
def random_poses() -> torch.Tensor:
    """(8, 3, 4) float64 random camera-to-world poses with rotations up to 2.5 rad."""
    generator = torch.Generator().manual_seed(0)
    vectors = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    vectors *= 2.5 / vectors.norm(dim=-1).max()
    positions = torch.randn(8, 3, 1, generator=generator, dtype=torch.float64)
    return torch.cat([rotation_from_vector(vectors), positions], -1)


@pytest.fixture(scope="module")
def small_work() -> Iterator[None]:
    """Compute light at few points."""
    from aenerf_ns.simulator.rendering import mesh_repair

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_repair, "NUM_CORNERS", 2000)
        yield


@pytest.fixture
def native(tmp_path: Path) -> Path:
    """A small dataset in the native format, without a scene box."""
    from helpers.small_datasets import write_native

    return write_native(tmp_path / "made")


@pytest.fixture
def ecd(tmp_path: Path) -> Path:
    """A small dataset in the Event Camera Dataset's format."""
    from helpers.small_datasets import write_ecd

    return write_ecd(tmp_path / "made")


@pytest.fixture
def box_file(tmp_path: Path) -> Path:
    """A mesh file with a textured box of 1.2 x 0.8 x 0.6 m."""
    from helpers.small_meshes import painted_box

    painted_box().export(tmp_path / "box.glb")
    return tmp_path / "box.glb"
