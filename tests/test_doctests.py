"""The examples in the docstrings of the public functions and classes."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    "module",
    [
        "aenerf_ns.camera.alignment",
        "aenerf_ns.camera.intrinsics",
        "aenerf_ns.camera.trajectory",
        "aenerf_ns.events.stream",
        "aenerf_ns.files.open",
        "aenerf_ns.simulator.esim",
    ],
)
def test_the_examples_of_a_module_give_what_they_say(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
