"""Run the files in examples/."""

from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(name: str) -> dict[str, object]:
    """Return the names that a script defines when it is started in the current folder."""
    # A configuration's class is found by the name of its module.
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"), name, "exec"), names)
    return names
