"""Whether two generations of the benchmark's datasets are identical byte for byte.

    python benchmarks/reproducibility.py --bench BENCH --scenes scenes/*/scene.json --output JSON

Makes each dataset of a benchmark's folder again, with another number of threads, and compares all files with those that
are there. Lists a hash of each: SHA-256 over the names and the contents of its files.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import tyro

from aenerf_ns.bench.environment import environment
from aenerf_ns.bench.plan import Dataset, Poses, Scale, plan, scene_name


@dataclass
class Reproducibility:
    """Make the benchmark's datasets again and compare."""

    bench: Path
    """Folder of aenerf bench."""
    output: Path
    """JSON file to write."""
    scenes: tuple[str, ...] = ("room", "object")
    """As aenerf bench was given them."""
    again: tuple[str, ...] = ()
    """The same scenes built or copied elsewhere, to make the datasets from; by default the same files."""
    speeds: tuple[Literal["easy", "hard"], ...] = ("easy", "hard")
    """As aenerf bench was given them."""
    scale: Scale = "tiny"
    """As aenerf bench was given it."""
    poses: Poses = "noise"
    """As aenerf bench was given it."""
    threads: int = 2
    """Threads to render with."""

    def main(self) -> None:
        """Compares and writes the hashes."""
        again = dict(zip(self.scenes, self.again or self.scenes, strict=True))
        runs = plan(self.scenes, self.speeds, self.poses, ("methods",), (0,), self.scale)
        rows = []
        for dataset in dict.fromkeys(run.dataset for run in runs):
            folder = self.bench / "datasets" / dataset.name
            if not folder.exists():
                continue
            first, second = hashes(folder), self._generate(dataset, again[dataset.scene])
            # aenerf bench adds this for image methods.
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
            print(json.dumps(rows[-1]), flush=True)
            self.output.write_text(
                json.dumps({"rows": rows, "threads": self.threads, **environment()}, indent=2) + "\n"
            )

    def _generate(self, dataset: Dataset, scene: str) -> dict[str, str]:
        with TemporaryDirectory() as folder:
            output = Path(folder) / "dataset"
            options = ("--output", str(output), "--scene", scene, *dataset.command[2:])
            threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
            subprocess.run(
                [Path(sys.executable).parent / "aenerf", "simulate", *options],
                check=True,
                capture_output=True,
                env={**os.environ, **threads},
            )
            return hashes(output)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file, by its name in the folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _digest(files: dict[str, str]) -> str:
    return hashlib.sha256("".join(f"{name} {value}\n" for name, value in sorted(files.items())).encode()).hexdigest()


if __name__ == "__main__":
    tyro.cli(Reproducibility).main()
