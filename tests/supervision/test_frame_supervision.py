"""Supervision by images: which images, which pixels, and what their renderings are compared with."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.small_datasets import AS_RECORDED, END, START, parse
from helpers.small_models import EPOCH, KNOTS, make_scene, make_supervision, pixels_of
from helpers.small_pipelines import make_pipeline_config
from PIL import Image

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.dataparsers.native import NativeDataParserConfig
from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.recording.scene import SCENE_KEY
from aenerf_ns.supervision.base import SamplerConfig
from aenerf_ns.supervision.peers.frames import FrameBatch, FrameSampler, FrameSupervision

SECONDS = (0.0, 0.25, 0.7)


def make_sampler(folder: Path, poses: torch.Tensor, pattern: BayerPattern = "", gray: bool = True) -> FrameSampler:
    """A sampler of three images; pixel i of image f has the values 80 f + 5 i, and the colors 1 and 2 more."""
    frames = []
    for index, seconds in enumerate(SECONDS):
        values = (80 * index + 5 * np.arange(12, dtype=np.uint8)).reshape(3, 4)
        picture = values if gray else np.stack([values, values + 1, values + 2], -1).astype(np.uint8)
        Image.fromarray(picture.astype(np.uint8)).save(folder / f"{index}.png")
        frames.append((EPOCH + round(seconds * 1e9), folder / f"{index}.png"))
    scene = make_scene(SensorModel(bayer_pattern=pattern), Trajectory(KNOTS, poses))
    dataset = SimpleNamespace(scene=replace(scene, frames=tuple(frames)))
    supervision = make_supervision(FrameSupervision, scene.sensor)
    return SamplerConfig(_target=FrameSampler).setup(dataset=dataset, supervision=supervision, device="cpu")


@pytest.mark.parametrize(("pattern", "gray"), [("", True), ("RGGB", True), ("RGGB", False)])
def test_a_pixel_has_the_value_of_its_image_and_the_ray_of_its_time(
    pattern: BayerPattern, gray: bool, random_poses: torch.Tensor, tmp_path: Path
) -> None:
    rays, batch = make_sampler(tmp_path, random_poses, pattern, gray).sample(600)
    assert rays.origins.shape == (600, 3)
    values = torch.round(batch.values * 255).long()
    assert values.shape == (600, 3 if pattern else 1)
    if pattern:
        assert (values - values[:, :1] == (torch.zeros(3).long() if gray else torch.arange(3))).all()
    pixels = pixels_of(rays)
    taken = torch.tensor(SECONDS, dtype=torch.float64)
    frames = (rays.times - taken).abs().argmin(1)
    torch.testing.assert_close(taken[frames], rays.times[:, 0], rtol=0, atol=1e-9)
    assert values[:, 0].tolist() == (80 * frames + 5 * torch.tensor(pixels)).tolist()
    # Images and pixels are drawn alike.
    assert len(set(zip(frames.tolist(), pixels, strict=True))) == 36


def test_a_monochrome_sensor_learns_the_luminance_that_metrics_compare_with(
    random_poses: torch.Tensor, tmp_path: Path
) -> None:
    sampler = make_sampler(tmp_path, random_poses)
    for index in range(len(SECONDS)):
        Image.new("RGB", (4, 3), "blue").save(tmp_path / f"{index}.png")
    _, batch = sampler.sample(10)
    # 0.0722 of the linear radiance.
    assert (255 * batch.values).round().unique().tolist() == [76]


def test_the_loss_is_the_squared_error_of_display_values() -> None:
    supervision = make_supervision(FrameSupervision, SensorModel())
    values = torch.tensor([[0.2], [0.5], [0.0]])
    log_radiance = torch.tensor([[0.3], [0.5], [0.1]]).log().requires_grad_()
    loss = supervision.losses({"log_radiance": log_radiance}, FrameBatch(values))["reconstruction_loss"]
    assert loss.item() == pytest.approx((0.01 + 0 + 0.01) / 3)
    loss.backward()
    torch.testing.assert_close(log_radiance.grad[:, 0], torch.tensor([0.06, 0.0, 0.02]) / 3)


def test_images_that_cannot_be_trained_on_end_with_one_line(random_poses: torch.Tensor, tmp_path: Path) -> None:
    sampler = make_sampler(tmp_path, random_poses)
    Image.new("L", (5, 3)).save(tmp_path / "1.png")
    with pytest.raises(DataError, match=r"1.png: the image has 5 x 3 pixels, its camera 4 x 3"):
        sampler.prepare()
    sampler.dataset.scene = replace(sampler.dataset.scene, frames=())
    with pytest.raises(DataError, match=r"no training images .*; make some with aenerf reconstruct"):
        sampler.prepare()


def test_a_dataset_hands_on_the_timed_training_images_of_the_event_camera(native: Path) -> None:
    config = NativeDataParserConfig(data=native, start_time_ns=START, end_time_ns=END, **AS_RECORDED)
    frames = parse(config).metadata[SCENE_KEY].frames
    assert [(time, file.name) for time, file in frames] == [
        (START, "00000.png"),
        (START + 150_000_000, "00001.png"),
        (END, "00002.png"),
    ]
    assert parse(config, "test").metadata[SCENE_KEY].frames == ()
    config.start_time_ns, config.end_time_ns = START + 1, END - 1
    assert [time for time, _ in parse(config).metadata[SCENE_KEY].frames] == [START + 150_000_000]
    meta = json.loads((native / "transforms.json").read_text())
    meta["fl_x"] += 1
    (native / "transforms.json").write_text(json.dumps(meta))
    assert parse(config).metadata[SCENE_KEY].frames == ()


def test_a_sampler_for_another_supervision_is_refused(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "data")
    config.datamanager = replace(config.datamanager, sampler=SamplerConfig(_target=FrameSampler))
    message = "its sampler draws a FrameBatch, and its supervision compares a PairBatch; give it"
    with pytest.raises(SystemExit, match=message):
        config.setup(device="cpu", test_mode="val")
