"""The examples and the code in the documents run and do what the text says."""

import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.examples import EXAMPLES, run_example
from helpers.small_datasets import make_trajectory, parse
from helpers.small_trainings import own_log

from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY

FORMAT_PAGE = EXAMPLES.parent / "docs" / "dataset_format.md"


def test_written_datasets_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_example("write_a_dataset")
    (described,) = re.findall(
        r"^```json\n(.*?)^```$", FORMAT_PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert json.loads(described) == json.loads(Path("scene/transforms.json").read_text())
    run_example("write_a_dataset_with_the_writer")
    capsys.readouterr()
    run_example("read_a_dataset")
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("20,000 events gave") == 2
    assert "val ['1.png'] test ['2.png']" in printed
    assert "val ['00000.png'] test ['00000.png']" in printed
    # Every digit of a Unix time is kept.
    (val,) = NativeDataParserConfig(data=Path("scene_from_writer")).setup().recording.reference_views["val"]
    assert val.time == 1_600_000_000_500_000_001


def test_smallest_transforms(native: Path) -> None:
    camera = json.loads((native / "transforms.json").read_text())["event_camera"]
    required = (
        "file", "width", "height", "fl_x", "fl_y", "cx", "cy", "positive_contrast_threshold",
        "negative_contrast_threshold",
    )  # fmt: skip
    (native / "transforms.json").write_text(json.dumps({"event_camera": {name: camera[name] for name in required}}))
    assert len(EventDataset(parse(NativeDataParserConfig(data=native))).pairs)


def test_format_of_your_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 500))
    np.savez(
        tmp_path / "events.npz", x=rng.integers(0, 64, 500), y=rng.integers(0, 8, 500), t=t, p=rng.integers(0, 2, 500)
    )
    poses = "".join(f"{0.1 * i:.1f} {0.1 * i:.1f} 0 -2 0 0 0 1\n" for i in range(11))
    (tmp_path / "poses.txt").write_text(poses)
    config = run_example("npz_format")["npz_dataparser"].config
    config.data = tmp_path
    dataset = EventDataset(parse(config))
    assert dataset.pairs.num_events == 500
    assert len(dataset.scene.trajectory) == 11
    assert dataset.scene.window.end == int(t[-1]) * 1_000


def test_way_back_to_the_world(native: Path, tmp_path: Path) -> None:
    outputs = parse(NativeDataParserConfig(data=native))
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    scene_opengl = outputs.metadata[SCENE_KEY].trajectory.camera_to_worlds.numpy()
    points, poses = runpy.run_path(str(EXAMPLES / "scene_to_world.py"))["load_world_from_scene"](tmp_path)
    world = torch.from_numpy(poses(scene_opengl) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    # The file holds float32.
    torch.testing.assert_close(world, make_trajectory().camera_to_worlds, rtol=0, atol=1e-5)
    expected = homogeneous(make_trajectory().camera_to_worlds)[:, :3, 3]
    np.testing.assert_allclose(points(scene_opengl[:, :, 3]), expected, rtol=0, atol=1e-5)


def test_supervision_of_your_own(native: Path, tmp_path: Path) -> None:
    with own_log():
        runpy.run_path(str(EXAMPLES / "add_a_supervision.py"))["main"](native, tmp_path / "outputs", 3)
    assert list((tmp_path / "outputs").rglob("step-000000002.ckpt"))


@pytest.mark.slow
def test_notebook(tmp_path: Path) -> None:
    """Runs with few steps: the cells, not the picture, are tested."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(EXAMPLES / "first_run.ipynb", 4)
    (steps,) = [cell for cell in notebook.cells if "STEPS = 300" in cell.source]
    steps.source = steps.source.replace("STEPS = 300", "STEPS = 3")
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert (tmp_path / "first_run" / "evaluation.json").is_file()
    assert notebook.cells[-2].outputs[0].output_type == "execute_result"
