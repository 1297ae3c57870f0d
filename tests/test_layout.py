"""How the project is laid out: which folder may use which, and what stands where."""

import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.source_files import imported_names

ROOT = Path(__file__).parents[1]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")

# The floors, bottom up, and what each stands on. A folder may also use itself.
MAY_USE: dict[str, set[str]] = {
    "errors": set(),
    "atomic_write": set(),
    "progress": set(),
    "threads": set(),
    "open3d_import": {"errors"},
    "camera": {"errors"},
    "events": {"errors", "camera"},
    # Events in, images out: where the camera was, and what the images are for, is not its business.
    "reconstruction": {"errors", "events"},
    "files": {"errors", "atomic_write", "progress", "events", "camera"},
    "recording": {"errors", "progress", "events", "camera", "files"},
    # Poses of a recording from its frames: a tool, which only commands and the simulator use.
    "pose_estimation": {"errors", "progress", "events", "reconstruction", "camera", "files", "recording"},
    "checking": {"progress", "events", "camera", "files", "recording"},
    "supervision": {"errors", "events", "camera", "recording"},
    "method": {"errors", "threads", "camera", "recording", "supervision"},
    # What is done with a trained run, without the trainer.
    "evaluation": {"errors", "progress", "camera", "recording", "supervision", "method", "checking"},
    # What the viewer shows of a run. It only looks: the pipeline hands it what it needs.
    "viewer": {"errors", "events", "camera", "files", "recording", "method", "evaluation"},
    "training": {"errors", "atomic_write", "files", "recording", "supervision", "method", "evaluation", "viewer"},
    # What training and checking left behind, measured and shown.
    "report": {
        "errors", "progress", "events", "camera", "files", "recording", "supervision", "evaluation", "training",
        "checking",
    },
    # Stands beside the method: only commands and benchmarks use it.
    "simulator": {"errors", "progress", "threads", "open3d_import", "events", "camera", "files", "pose_estimation"},
    # What other tools take from a trained run.
    "export": {"errors", "progress", "open3d_import", "events", "camera", "files", "recording", "evaluation"},
    "dataparsers": {"errors", "events", "camera", "files", "recording"},
    "method_configs": {"supervision", "method", "training", "dataparsers"},
    "cli": {
        "errors", "progress", "open3d_import", "events", "reconstruction", "camera", "files", "recording",
        "pose_estimation", "method", "evaluation", "training", "checking", "export", "report", "simulator",
        "dataparsers",
    },
}  # fmt: skip


def _modules() -> Iterator[tuple[str, Path]]:
    """Each source file with the folder, or the file at the top, that it belongs to."""
    for folder in ("dataparsers", "method_configs"):
        yield from ((folder, path) for path in (ROOT / folder).rglob("*.py"))
    for path in (ROOT / "aenerf_ns").rglob("*.py"):
        folder = path.relative_to(ROOT / "aenerf_ns").with_suffix("").parts[0]
        if folder != "__init__":
            yield folder, path


@pytest.mark.parametrize("folder", MAY_USE)
def test_imports_are_allowed(folder: str) -> None:
    for own, path in _modules():
        if own == folder:
            used = {name.split(".")[1] for name in imported_names(path) if name.startswith("aenerf_ns.")}
            assert used - {folder} <= MAY_USE[folder], path


def test_floors_are_ordered_and_complete() -> None:
    order = list(MAY_USE)
    for folder, used in MAY_USE.items():
        assert all(order.index(name) < order.index(folder) for name in used)
    assert {folder for folder, _ in _modules()} == set(MAY_USE)


def test_modules_form_no_circle() -> None:
    """Imports within functions and under TYPE_CHECKING count: what types refer to, a reader must know too."""
    paths = {}
    for _, path in _modules():
        parts = path.relative_to(ROOT).with_suffix("").parts
        paths[".".join(parts[parts[0] == "aenerf_ns" :]).removesuffix(".__init__")] = path
    imported = {
        name: {module.removeprefix("aenerf_ns.") for module in imported_names(path)} & paths.keys() - {name}
        for name, path in paths.items()
    }
    # Raises a CycleError that names the modules of the circle.
    graphlib.TopologicalSorter(imported).prepare()


def test_benchmarks_are_not_imported() -> None:
    for _, path in _modules():
        assert "benchmarks" not in {name.split(".")[0] for name in imported_names(path)}, path


def test_dataparsers_holds_formats_only() -> None:
    files = {f"aenerf_ns.dataparsers.{path.stem}" for path in (ROOT / "dataparsers").glob("*.py")}
    others = {"aenerf_ns.dataparsers.__init__", "aenerf_ns.dataparsers.formats"}
    assert files - others == files & imported_names(ROOT / "dataparsers/formats.py")


def test_method_configs_holds_registered_methods_only() -> None:
    entries = re.findall(r'^([\w-]+) = "aenerf_ns\.method_configs\.(\w+):(\w+)"$', PROJECT, re.MULTILINE)
    assert all(name.replace("-", "_") == attribute for name, _, attribute in entries)
    files = {path.stem for path in (ROOT / "method_configs").glob("*.py")} - {"__init__"}
    assert files == {module for _, module, _ in entries}
