"""Start-up time of ns-render on a trained run: from the command to the first rendered picture.

    python benchmarks/start_up.py --load-config outputs/.../config.yml --output benchmarks/results/NAME.json

Beside it, in the same run: the framework's import alone, and ns-render with the event file taken away.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
import yaml

from aenerf_ns.bench.environment import environment

_CAMERA_PATH = {
    "render_height": 12,
    "render_width": 16,
    "camera_type": "perspective",
    "fps": 1,
    "seconds": 1.0,
    "camera_path": [{"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 60, "aspect": 4 / 3}],
}


@dataclass
class StartUp:
    """Measure the start-up of ns-render."""

    load_config: Path
    """config.yml of the run, of a dataset in the native format."""
    output: Path
    """JSON file to write."""
    repeats: int = 5
    """Times that each is run."""

    def main(self) -> None:
        """Measures and writes the figures."""
        scripts = Path(sys.executable).parent
        config = yaml.load(self.load_config.read_text(), Loader=yaml.Loader)
        events = Path(config.pipeline.datamanager.data) / "events.h5"
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "path.json"
            path.write_text(json.dumps(_CAMERA_PATH))
            render = [
                scripts / "ns-render", "camera-path", "--load-config", self.load_config,
                "--camera-path-filename", path, "--output-path", Path(folder) / "out", "--output-format", "images",
            ]  # fmt: skip
            importing = [sys.executable, "-c", "import nerfstudio.scripts.render"]
            hidden = events.with_suffix(".hidden")
            seconds: dict[str, list[float]] = {
                "import_of_ns_render": [],
                "ns_render_one_tiny_picture": [],
                "ns_render_without_the_event_file": [],
            }
            # In turns, so that whatever else the machine does slows all of them alike.
            for _ in range(self.repeats):
                seconds["import_of_ns_render"].append(_time(importing))
                seconds["ns_render_one_tiny_picture"].append(_time(render))
                events.rename(hidden)
                try:
                    seconds["ns_render_without_the_event_file"].append(_time(render))
                finally:
                    hidden.rename(events)
            size = events.stat().st_size
        result = {
            "seconds": {
                name: {"median": sorted(times)[len(times) // 2], "least": min(times), "most": max(times)}
                for name, times in seconds.items()
            },
            "event_file_bytes": size,
            "repeats": self.repeats,
            **environment(),
        }
        self.output.write_text(json.dumps(result, indent=2) + "\n")
        print(json.dumps(result, indent=2))


def _time(command: list) -> float:
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - begin


if __name__ == "__main__":
    tyro.cli(StartUp).main()
