"""Make a recording of a sequence of MVSEC: start it in the folder of the files.

Read in the authors' data format and code, and in DEVO's loaders; not yet tried on the real files."""

import shutil
from pathlib import Path

import h5py
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

name, side = "indoor_flying1", "left"
folder = Path("mvsec")
(folder / "images").mkdir(parents=True)

with h5py.File(f"{name}_data.hdf5") as file:
    camera = file["davis"][side]
    rows = camera["events"]
    events = np.lib.format.open_memmap(folder / "events.npy", "w+", np.float64, rows.shape)
    for first in range(0, len(rows), 1_000_000):
        events[first : first + 1_000_000] = rows[first : first + 1_000_000]
    events.flush()
    with (folder / "images.txt").open("w") as file_list:
        for index, time in enumerate(camera["image_raw_ts"]):
            Image.fromarray(camera["image_raw"][index]).save(folder / f"images/{index:06d}.png")
            file_list.write(f"{time:.9f} images/{index:06d}.png\n")

with h5py.File(f"{name}_gt.hdf5") as file:
    poses, times = file["davis"][side]["pose"][:], file["davis"][side]["pose_ts"][:]
with (folder / "trajectory.txt").open("w") as trajectory:
    for time, pose in zip(times, poses, strict=True):
        values = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        trajectory.write(f"{time:.9f} {' '.join(f'{value:.12g}' for value in values)}\n")

shutil.copy("indoor_flying_calib/camchain-imucam-indoor_flying.yaml", folder / "camchain.yaml")
