"""The figures of trained runs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.small_pipelines import make_pipeline
from helpers.small_trainings import train_small_model
from helpers.streams import make_stream
from nerfstudio.cameras.rays import RayBundle, RaySamples
from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.writer import NativeDatasetWriter
from benchmarks.paper_figures import PaperFigures, march


def write_data(folder: Path) -> None:
    """Three poses, two events, and views of 16 x 12 pixels with depth."""
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.1, 0.0, 0.1])
    camera, box = CameraIntrinsics(16, 12, 12.0, 12.0, 8.0, 6.0), np.array([[-2.0, -2.0, -1.0], [2.0, 2.0, 3.0]])
    with NativeDatasetWriter(folder, camera, SensorModel(), "srgb", box) as writer:
        writer.events.append(make_stream([(1, 1, 0, 1), (1, 1, 10**9, -1)], 16, 12))
        trajectory = Trajectory([0, 5 * 10**8, 10**9], poses)
        writer.add_trajectories(trajectory, trajectory)
        for split, value in (("val", 102), ("test", 204), ("test", 51)):
            depth = np.linspace(1, 2, 12 * 16, dtype=np.float32).reshape(12, 16)
            writer.add_image(split, np.full((12, 16, 3), value, np.uint8), poses[2], depth=depth)


def test_draw_figures_of_two_runs(tmp_path: Path) -> None:
    write_data(tmp_path / "data")
    runs = {name: train_small_model(tmp_path, name, steps).base_dir for name, steps in (("short", 2), ("long", 5))}
    PaperFigures(runs, tmp_path / "figures", views=1).main()
    assert {file.name for file in (tmp_path / "figures").iterdir()} == {"samples.png", "paths.png", "view_00001.png"}
    # Pictures, errors and depth: the truth, and two runs.
    tiles = np.asarray(Image.open(tmp_path / "figures" / "view_00001.png").convert("RGB"))
    assert tiles.shape == (14 + 3 * 144 + 2 * 4, 3 * 192 + 2 * 4, 3)
    assert (tiles[14 : 14 + 144, :192] == 51).all()


def test_march_through_occupied_cells_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make_pipeline(tmp_path / "data", "test").trained_run()

    def slabs(samples: RaySamples) -> tuple[torch.Tensor, None]:
        depth = -samples.frustums.get_positions()[..., 2:]
        return 20.0 * ((depth > 0.5) & (depth < 0.6)) + 1e5 * (depth > 0.8), None

    monkeypatch.setattr(run.model.field, "get_density", slabs)
    ends = {"nears": torch.tensor([[0.05]]), "fars": torch.tensor([[1000.0]])}
    down = RayBundle(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]]), torch.ones(1, 1), **ends)
    (found,) = march(run, down)
    cell = 2 / 128
    within = (found > 0.5 - cell) & (found < 0.6 + cell)
    assert 20 < within.sum() < len(found)
    # Nothing is seen through the opaque second one.
    assert ((found[~within] > 0.8 - cell) & (found[~within] < 0.8 + cell)).all()
