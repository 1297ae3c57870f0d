"""The documentation names options, files and pages that exist."""

import re
import runpy
from pathlib import Path

import pytest
import tyro

from aenerf_ns.method_configs.aenerf import aenerf
from aenerf_ns.method_configs.aenerf_mlp import aenerf_mlp
from aenerf_ns.method_configs.peers import eventnerf, evnerf, paev3d

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]

# The beginnings of paths of the repository; other paths are files of datasets and results.
FOLDERS = "aenerf_ns|benchmarks|dataparsers|docs|method_configs|scripts|tests"


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_options_page_is_current() -> None:
    page = runpy.run_path(str(ROOT / "scripts" / "write_options.py"))["options_page"]()
    written = (ROOT / "docs" / "options.md").read_text(encoding="utf-8")
    assert written == page, "options have changed: run `python scripts/write_options.py`"


@pytest.fixture(scope="module")
def flags() -> set[str]:
    """The flags of ns-train with the methods of this project."""
    methods = (aenerf, aenerf_mlp, eventnerf, evnerf, paev3d)
    parsers = [tyro.extras.get_parser(type(method.config), default=method.config) for method in methods]
    return {flag for parser in parsers for action in parser._actions for flag in action.option_strings}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_page_names_what_exists(page: Path, flags: set[str]) -> None:
    """Options of ns-train, paths of the repository and linked files."""
    text = page.read_text(encoding="utf-8")
    # Not the beginnings of flags, as in `--pipeline.model.field.*`.
    named = re.findall(r"--(?:pipeline|optimizers|gradient)[\w.-]*(?<![.-])(?![\w.*-])", text)
    assert set(named) <= flags
    for path in re.findall(rf"`((?:{FOLDERS})/[\w./-]*)`", text):
        assert (ROOT / path).exists(), path
    # The site's build checks the headings too; this one also holds where mkdocs is not installed.
    for target in re.findall(r"\]\(([^)#\s:]+)(?:#[^)\s]*)?\)", text):
        assert (page.parent / target).exists(), target
