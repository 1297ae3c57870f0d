"""Small work for the tests of the simulator, and its built-in scenes, which are lit once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numba
import pytest
from small_meshes import painted_box

from aenerf_ns.simulator.open_scene import built_in_scene
from aenerf_ns.simulator.rendering import mesh_repair
from aenerf_ns.simulator.scene import SimulationScene


@pytest.fixture(scope="session", autouse=True)
def small_work() -> Iterator[None]:
    """Use one thread, because the pictures are too small to share, and compute light at few points."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_repair, "_POINTS", 2000)
        yield
    numba.set_num_threads(threads)


@pytest.fixture(scope="session")
def room() -> SimulationScene:
    return built_in_scene("room")


@pytest.fixture(scope="session")
def toy() -> SimulationScene:
    return built_in_scene("object")


@pytest.fixture
def box_file(tmp_path: Path) -> Path:
    """A mesh file with a box of 1.2 x 0.8 x 0.6 m."""
    painted_box().export(tmp_path / "box.glb")
    return tmp_path / "box.glb"
