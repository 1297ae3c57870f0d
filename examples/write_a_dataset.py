"""Write a dataset folder from NumPy arrays, with h5py and text files alone."""

import json
from pathlib import Path

import h5py
import numpy as np
from PIL import Image

folder = Path("scene")
(folder / "images").mkdir(parents=True)
rng = np.random.default_rng(0)
n, width, height = 20_000, 64, 48

# Events: here random ones, over one second.
with h5py.File(folder / "events.h5", "w") as file:
    events = file.create_group("events")
    events.attrs["time_unit"] = "ns"
    events["x"] = rng.integers(0, width, n).astype(np.uint16)
    events["y"] = rng.integers(0, height, n).astype(np.uint16)
    events["t"] = np.sort(rng.integers(0, 1_000_000_000, n)).astype(np.int64)
    events["p"] = (2 * rng.integers(0, 2, n) - 1).astype(np.int8)

# Poses: 26 of them, 40 ms apart. Times are printed from integers, so that no digit is lost.
with (folder / "trajectory_estimated.txt").open("w") as file:
    for i in range(26):
        ns = 40_000_000 * i
        file.write(f"{ns // 10**9}.{ns % 10**9:09d} {0.004 * i} 0 -2 0 0 0 1\n")

for i in range(3):
    Image.fromarray(np.full((height, width), 100 + i, np.uint8)).save(folder / f"images/{i}.png")

lens = {"fl_x": 60.0, "fl_y": 60.0, "cx": width / 2, "cy": height / 2}
test_pose = [[1, 0, 0, 0.05], [0, -1, 0, 0], [0, 0, -1, -2], [0, 0, 0, 1]]
meta = {
    "w": width,
    "h": height,
    **lens,
    "image_encoding": "srgb",
    "event_camera": {
        "file": "events.h5",
        "width": width,
        "height": height,
        **lens,
        "camera_model": "OPENCV",
        "k1": -0.1,
        "k2": 0.02,
        "p1": 0.0,
        "p2": 0.0,
        "k3": 0.0,
        "positive_contrast_threshold": 0.25,
        "negative_contrast_threshold": 0.25,
        "refractory_period_ns": 1000,
        "bayer_pattern": "",
    },
    "frames": [
        {"file_path": "images/0.png", "timestamp": 0.25},
        {"file_path": "images/1.png", "timestamp": 0.5},
        {"file_path": "images/2.png", "transform_matrix": test_pose},
    ],
    "train_filenames": ["images/0.png"],
    "val_filenames": ["images/1.png"],
    "test_filenames": ["images/2.png"],
}
(folder / "transforms.json").write_text(json.dumps(meta, indent=2))
