"""E2VID's and FireNet's networks: parameters by the names of the authors' files, and how they run."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.streams import make_stream, random_stream

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import BayerPattern, SensorModel
from aenerf_ns.reconstruction.batches import batches_of
from aenerf_ns.reconstruction.images import NetworkImages, demosaic
from aenerf_ns.reconstruction.networks import ConvGRU, ConvLSTM, FireNet
from aenerf_ns.reconstruction.weights import load_network


def convolution(name: str, *shape: int, bias: bool = True) -> dict[str, tuple[int, ...]]:
    """Return the entries of a convolution in a state dict."""
    return {f"{name}.weight": shape, **({f"{name}.bias": (shape[0],)} if bias else {})}


def normalization(name: str, size: int) -> dict[str, tuple[int, ...]]:
    """Return the entries of a batch normalization in a state dict."""
    names = ("weight", "bias", "running_mean", "running_var")
    return {**{f"{name}.{part}": (size,) for part in names}, f"{name}.num_batches_tracked": ()}


def e2vid_entries() -> dict[str, tuple[int, ...]]:
    entries = convolution("head.conv2d", 32, 5, 5, 5)
    for index, size in enumerate((64, 128, 256)):
        entries |= convolution(f"encoders.{index}.conv.conv2d", size, size // 2, 5, 5, bias=False)
        entries |= normalization(f"encoders.{index}.conv.norm_layer", size)
        entries |= convolution(f"encoders.{index}.recurrent_block.Gates", 4 * size, 2 * size, 3, 3)
        decoder = f"decoders.{2 - index}"
        entries[f"{decoder}.transposed_conv2d.weight"] = (size, size // 2, 5, 5)
        entries |= normalization(f"{decoder}.norm_layer", size // 2)
    for block in ("resblocks.0", "resblocks.1"):
        for part in ("1", "2"):
            entries |= convolution(f"{block}.conv{part}", 256, 256, 3, 3, bias=False)
            entries |= normalization(f"{block}.bn{part}", 256)
    entries |= convolution("pred.conv2d", 1, 32, 1, 1, bias=False) | normalization("pred.norm_layer", 1)
    return {f"unetrecurrent.{name}": shape for name, shape in entries.items()}


def firenet_entries() -> dict[str, tuple[int, ...]]:
    entries = convolution("head.conv.conv2d", 16, 5, 3, 3) | convolution("pred.conv2d", 1, 16, 1, 1)
    for layer in ("head", "resblocks.0"):
        for gate in ("reset_gate", "update_gate", "out_gate"):
            entries |= convolution(f"{layer}.recurrent_block.{gate}", 16, 32, 3, 3)
    for block in ("resblocks.0.conv", "resblocks.1"):
        for part in ("conv1", "conv2"):
            entries |= convolution(f"{block}.{part}", 16, 16, 3, 3)
    return {f"net.{name}": shape for name, shape in entries.items()}


def made(entries: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Return random weights by names and shapes, and variances that are positive."""
    generator = torch.Generator().manual_seed(0)
    weights = {}
    for name, shape in entries.items():
        # Of a size that keeps the features of one layer after another alive.
        scale = (2 / math.prod(shape[1:])) ** 0.5 if len(shape) == 4 else 0.2
        weights[name] = scale * torch.randn(shape, generator=generator)
        if name.endswith("running_var"):
            weights[name] = torch.rand(shape, generator=generator) + 0.5
        elif name.endswith("num_batches_tracked"):
            weights[name] = torch.tensor(7)
    return weights


ENTRIES = {"e2vid": e2vid_entries(), "firenet": firenet_entries()}


def save(path: Path, name: str, **changes: object) -> Path:
    torch.save({"arch": name, "epoch": 3, "state_dict": made(ENTRIES[name]), **changes}, path)
    return path


@pytest.mark.parametrize(("name", "number", "weights"), [("e2vid", 74, 10_715_503), ("firenet", 24, 37_777)])
def test_load_documented_weights(name: str, number: int, weights: int, tmp_path: Path) -> None:
    assert len(ENTRIES[name]) == number
    network = load_network(save(tmp_path / "weights.pth.tar", name))
    assert not network.training
    assert sum(values.numel() for values in network.state_dict().values()) == weights
    for key, values in made(ENTRIES[name]).items():
        assert torch.equal(network.state_dict()[key.removeprefix(f"{network.name_in_file}.")], values)


@pytest.mark.parametrize("name", ["e2vid", "firenet"])
def test_refuse_unusable_weights(name: str, tmp_path: Path) -> None:
    file = "E2VID_lightweight.pth.tar" if name == "e2vid" else "firenet_1000.pth.tar"
    where, kind = f"{file}, which https://github.com/", "E2VID" if name == "e2vid" else "FireNet"
    weights = made(ENTRIES[name])
    first = next(iter(weights))
    faults: list[tuple[Path, str]] = [
        (tmp_path / "none.pth", "none.pth: there is no such file"),
        (tmp_path / ("n" * 300), "n: it cannot be read"),
        (save(tmp_path / "code.pth", name, config=Path("x")), "code.pth: not a file of plain weights"),
        (save(tmp_path / "empty.pth", name, state_dict=None), "empty.pth: it holds no state_dict"),
        (save(tmp_path / "number.pth", name, state_dict={1: torch.zeros(1)}), "number.pth: it holds no state_dict"),
    ]
    for changed, state in (
        ("other", {**weights, "other": torch.zeros(1)}),
        (first, {key: value for key, value in weights.items() if key != first}),
        (first, {**weights, first: torch.zeros(3)}),
    ):
        path = save(tmp_path / f"{len(faults)}.pth", name, state_dict=state)
        faults.append((path, f"its weights are not those of {kind} .*{changed}"))
    for path, complaint in faults:
        with pytest.raises(DataError, match=complaint) as raised:
            load_network(path)
        assert where in str(raised.value) or "cannot be read" in complaint


def test_gate_order() -> None:
    features = torch.ones(1, 1, 1, 1)
    lstm = ConvLSTM(1)
    with torch.no_grad():
        lstm.Gates.weight.zero_()
        lstm.Gates.bias.copy_(torch.tensor([0.3, -0.7, 1.1, 0.9]))
        hidden, cell = lstm(features, (features, 2 * features))
    take, keep, show = torch.tensor([0.3, -0.7, 1.1]).sigmoid().tolist()
    assert cell.item() == pytest.approx(keep * 2 + take * np.tanh(0.9), rel=1e-6)
    assert hidden.item() == pytest.approx(show * np.tanh(cell.item()), rel=1e-6)
    gru = ConvGRU(1)
    with torch.no_grad():
        for gate, bias in (("reset_gate", 0.4), ("update_gate", -0.6), ("out_gate", 0.2)):
            getattr(gru, gate).weight.zero_()
            getattr(gru, gate).bias.fill_(bias)
        # The new state sees the old one through the reset gate.
        gru.out_gate.weight[0, 1, 1, 1] = 0.5
        state = gru(features, 3 * features)
    reset, update = torch.tensor([0.4, -0.6]).sigmoid().tolist()
    assert state.item() == pytest.approx((1 - update) * 3 + update * np.tanh(0.2 + 0.5 * 3 * reset), rel=1e-6)


@pytest.mark.parametrize("pattern", ["", "RGGB"])
@pytest.mark.parametrize("name", ["e2vid", "firenet"])
def test_images_of_a_sensor(name: str, pattern: str, tmp_path: Path) -> None:
    network = load_network(save(tmp_path / "weights.pth.tar", name))
    sensor = SensorModel(bayer_pattern="RGGB" if pattern else "")
    events = random_stream(400, 13, 10, 4000)
    found = list(NetworkImages(network, sensor, "cpu")(batches_of([events[:150], events[150:]], 130)))
    assert [time for time, _ in found] == events.t[[129, 259, 389]].tolist()
    assert all(image.shape == (10, 13, 3) and image.dtype == np.uint8 for _, image in found)
    ((_, fresh),) = NetworkImages(network, sensor, "cpu")([events[130:260]])
    assert (fresh != found[1][1]).any()
    is_gray = (found[0][1] == found[0][1][..., :1]).all()
    assert is_gray == (not pattern)


def test_padding_is_removed() -> None:
    class Echo(FireNet):
        multiple = 8

        def forward(self, voxels: torch.Tensor, state: object) -> tuple[torch.Tensor, object]:
            assert voxels.shape[2:] == (16, 16)
            return voxels.sum(1, keepdim=True).clamp(0, 1), state

    # One positive event, normalized to zero, would be invisible: two of different size.
    events = make_stream([(3, 2, 0, 1), (3, 2, 0, 1), (12, 8, 0, 1)], 13, 9)
    ((_, image),) = NetworkImages(Echo(), SensorModel(), "cpu")([events])
    assert np.unravel_index(image[..., 0].argmax(), (9, 13)) == (2, 3)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_demosaic_one_color(pattern: BayerPattern) -> None:
    channels = SensorModel(bayer_pattern=pattern).channels(8, 6)
    mosaic = np.array([200, 120, 50], np.uint8)[channels]
    assert ["RGB"[channel] for channel in channels[:2, :2].flat] == list(pattern)
    assert (demosaic(mosaic, pattern) == [200, 120, 50]).all()
