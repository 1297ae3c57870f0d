"""Test whether the benchmark's datasets, simulated twice, are identical byte for byte.

    python -m benchmarks.reproducibility --bench BENCH --scenes scenes/*/scene.json --output JSON

Simulates each dataset of a benchmark's folder again, with another number of threads, and compares all files. The result
lists a SHA-256 hash of each dataset, over the names and the contents of its files.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from aenerf_ns.errors import DataError
from benchmarks.paper.plan import Poses, Scale, plan, scene_name
from benchmarks.runs import run_benchmark, run_command, script, write_result


@dataclass
class Reproducibility:
    """Simulate the benchmark's datasets again and compare."""

    bench: Path
    """Folder that python -m benchmarks.paper has written."""
    output: Path
    """JSON file to write."""
    scenes: tuple[str, ...] = ("room", "object")
    """As given to the benchmark."""
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
        runs = plan(self.scenes, self.speeds, self.poses, ("methods",), (0,), self.scale)
        rows = []
        for dataset in dict.fromkeys(run.dataset for run in runs):
            folder = self.bench / "datasets" / dataset.name
            if not folder.exists():
                continue
            first = hash_files(folder)
            # The benchmark adds this file for image methods.
            first.pop("transforms_ground_truth.json", None)
            with TemporaryDirectory() as temporary:
                again, log = Path(temporary) / "dataset", Path(temporary) / "log"
                threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(self.threads))
                run_command(
                    (script("aenerf"), "simulate", "--output", str(again), *dataset.command), log, Path(), **threads
                )
                second = hash_files(again)
            different = sorted(name for name in {*first, *second} if first.get(name) != second.get(name))
            listing = "".join(f"{name} {value}\n" for name, value in sorted(first.items()))
            rows.append(
                {
                    "scene": scene_name(dataset.scene),
                    "speed": dataset.speed,
                    "simulate": " ".join(dataset.command),
                    "files": len(first),
                    "identical": not different,
                    "different": different,
                    "sha256": hashlib.sha256(listing.encode()).hexdigest(),
                    "events_sha256": first["events.h5"],
                }
            )
            write_result(self.output, {"rows": rows, "threads": self.threads})
        if not rows:
            raise DataError(self.bench, "it has none of the datasets", "give the options that the benchmark was given")


def hash_files(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file, by its name in the folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


if __name__ == "__main__":
    run_benchmark(Reproducibility)
