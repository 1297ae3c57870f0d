"""Run the files in examples/."""

import runpy
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(name: str) -> dict[str, Any]:
    """Return the names that a script defines when it is started in the current folder."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
