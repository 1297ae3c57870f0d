"""Test whether the benchmark's datasets, simulated twice, are identical byte for byte.

    python -m benchmarks.reproducibility --bench BENCH --scenes scenes/*/scene.json --output JSON

Simulates each dataset of a benchmark's folder again, with another number of threads, and compares all files. The result
lists a SHA-256 hash of each dataset, over the names and the contents of its files.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import tyro

from benchmarks.common import script, write_result
from benchmarks.paper.plan import Dataset, Poses, Scale, plan, scene_name


@dataclass
class Reproducibility:
    """Simulate the benchmark's datasets again and compare."""

    bench: Path
    """Folder that python -m benchmarks.paper has written."""
    output: Path
    """JSON file to write."""
    scenes: tuple[str, ...] = ("room", "object")
    """As given to the benchmark."""
    again: tuple[str, ...] = ()
    """The same scenes, built or copied elsewhere. By default the same files."""
    speeds: tuple[Literal["easy", "hard"], ...] = ("easy", "hard")
    """As given to the benchmark."""
    scale: Scale = "tiny"
    """As given to the benchmark."""
    poses: Poses = "noise"
    """As given to the benchmark."""
    threads: int = 2
    """Number of threads that render."""

    def main(self) -> None:
        """Compare, and write the hashes after each dataset."""
        again = dict(zip(self.scenes, self.again or self.scenes, strict=True))
        runs = plan(self.scenes, self.speeds, self.poses, ("methods",), (0,), self.scale)
        rows = []
        for dataset in dict.fromkeys(run.dataset for run in runs):
            folder = self.bench / "datasets" / dataset.name
            if not folder.exists():
                continue
            first, second = hashes(folder), self._generate(dataset, again[dataset.scene])
            # The benchmark adds this file for image methods.
            first.pop("transforms_ground_truth.json", None)
            different = sorted(name for name in {*first, *second} if first.get(name) != second.get(name))
            rows.append(
                {
                    "scene": scene_name(dataset.scene),
                    "speed": dataset.speed,
                    "simulate": " ".join(dataset.command),
                    "files": len(first),
                    "identical": not different,
                    "different": different,
                    "sha256": _digest(first),
                    "events_sha256": first["events.h5"],
                }
            )
            write_result(self.output, {"rows": rows, "threads": self.threads})
        if not rows:
            sys.exit(f"Error: {self.bench}: it has none of the datasets; give the options that the benchmark was given")

    def _generate(self, dataset: Dataset, scene: str) -> dict[str, str]:
        with TemporaryDirectory() as folder:
            output = Path(folder) / "dataset"
            options = ("--output", str(output), "--scene", scene, *dataset.command[2:])
            threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
            subprocess.run(
                [script("aenerf"), "simulate", *options],
                check=True,
                capture_output=True,
                env={**os.environ, **threads},
            )
            return hashes(output)


def hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file, by its name in the folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _digest(files: dict[str, str]) -> str:
    return hashlib.sha256("".join(f"{name} {value}\n" for name, value in sorted(files.items())).encode()).hexdigest()


if __name__ == "__main__":
    tyro.cli(Reproducibility).main()
