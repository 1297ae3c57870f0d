"""What is used of Nerfstudio although it is private: that it exists, and that nothing else is."""

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

from aenerf_ns.training.framework import USED_NAMES

PACKAGE = Path(__file__).parents[2] / "aenerf_ns"


@pytest.mark.parametrize("owner", USED_NAMES)
def test_names_exist(owner: str) -> None:
    module, _, cls = owner.partition(":")
    found = importlib.import_module(module)
    for name in USED_NAMES[owner]:
        if cls:
            # Attributes of instances are nowhere but in the source of the class.
            assert re.search(rf"\b{name}\b", inspect.getsource(getattr(found, cls))), name
        else:
            assert hasattr(found, name)


def test_no_private_name_of_nerfstudio_is_imported() -> None:
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nerfstudio"):
                names = [*node.module.split("."), *(alias.name for alias in node.names)]
                assert not any(name.startswith("_") for name in names), path
                if path.name != "framework.py":
                    assert not {"EVENT_WRITERS", "EVENT_STORAGE", "GLOBAL_BUFFER"} & {*names}, path
