"""The code in the documents runs and does what the text says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.small_datasets import make_trajectory, parse, write_native

from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.scene import SCENE_KEY

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str, language: str) -> list[str]:
    """The blocks of code in a language on a page."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def run(code: str, **names: object) -> dict[str, object]:
    """The names that the code defines."""
    # A format's module is found by its name when its classes are made.
    names["__name__"] = "__main__"
    exec(compile(code, "document", "exec"), names)
    return names


def test_the_datasets_that_the_page_writes_are_those_it_describes_and_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    by_hand, with_writer, read, _ = blocks("dataset_format.md", "python")
    run(by_hand)
    (described,) = blocks("dataset_format.md", "json")
    assert json.loads(described) == json.loads(Path("scene/transforms.json").read_text())
    run(with_writer)
    printed = capsys.readouterr().out
    run(read)
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("20,000 events gave") == 2
    assert "val ['1.png'] test ['2.png']" in printed
    assert "val ['00000.png'] test ['00000.png']" in printed
    # Every digit of a Unix time is kept.
    (val,) = NativeDataParserConfig(data=Path("scene_from_writer")).setup().recording.reference_views["val"]
    assert val.time == 1_600_000_000_500_000_001


def test_the_smallest_file_of_cameras_is_enough(tmp_path: Path) -> None:
    folder = write_native(tmp_path / "made")
    camera = json.loads((folder / "transforms.json").read_text())["event_camera"]
    required = [
        "file",
        "width",
        "height",
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        "positive_contrast_threshold",
        "negative_contrast_threshold",
    ]
    (folder / "transforms.json").write_text(json.dumps({"event_camera": {name: camera[name] for name in required}}))
    assert len(EventDataset(parse(NativeDataParserConfig(data=folder))).pairs)


def test_the_documented_format_reads_a_folder(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 500))
    np.savez(
        tmp_path / "events.npz", x=rng.integers(0, 64, 500), y=rng.integers(0, 8, 500), t=t, p=rng.integers(0, 2, 500)
    )
    poses = "".join(f"{0.1 * i:.1f} {0.1 * i:.1f} 0 -2 0 0 0 1\n" for i in range(11))
    (tmp_path / "poses.txt").write_text(poses)
    module = run(blocks("dataset_format.md", "python")[-1])
    config = module["npz_dataparser"].config  # type: ignore[attr-defined]
    config.data = tmp_path
    dataset = EventDataset(parse(config))
    assert dataset.pairs.num_events == 500
    assert len(dataset.scene.trajectory) == 11
    assert dataset.scene.window.end == int(t[-1]) * 1_000
    # The entry point names what the module registers.
    (entry,) = blocks("dataset_format.md", "toml")
    assert "aenerf_ns.dataparsers.npz:npz_dataparser" in entry
    assert module["__doc__"].startswith("dataparsers/npz.py")  # type: ignore[attr-defined]


def test_the_documented_way_back_to_the_world_is_the_inverse(tmp_path: Path) -> None:
    outputs = parse(NativeDataParserConfig(data=write_native(tmp_path / "made")))
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    scene_opengl = outputs.metadata[SCENE_KEY].trajectory.camera_to_worlds.numpy()
    (code,) = blocks("coordinate_frames.md", "python")
    code, count = re.subn(r'Path\("outputs/[^"]*"\)', "run", code)
    assert count == 1
    names = run(code, run=tmp_path, scene_opengl=scene_opengl)
    world = torch.from_numpy(np.asarray(names["world_opencv"]))
    # The file holds float32.
    torch.testing.assert_close(world, make_trajectory().camera_to_worlds, rtol=0, atol=1e-5)
    points = names["points"](scene_opengl[:, :, 3])  # type: ignore[operator]
    np.testing.assert_allclose(points, homogeneous(make_trajectory().camera_to_worlds)[:, :3, 3], rtol=0, atol=1e-5)
