"""Check the paths of a command line before the import of the framework, which takes a quarter of a minute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from itertools import pairwise, takewhile
from pathlib import Path

from aenerf_ns.files.given_paths import require_dataset, require_new, require_run

_WORKS_ON: dict[str, tuple[str, Callable[[Path], object]]] = {
    "check": ("--data", require_dataset),
    "convert": ("--data", require_dataset),
    "reconstruct": ("--data", require_dataset),
    "evaluate": ("--load-config", require_run),
    "export-trajectory": ("--load-config", require_run),
    "export-cameras": ("--load-config", require_run),
    "export-frames": ("--load-config", require_run),
    "export-mesh": ("--load-config", require_run),
    "export-video": ("--load-config", require_run),
}
_WRITES_FOLDER = {"simulate", "convert", "reconstruct", "export-cameras", "export-frames"}


def judge_paths(words: Sequence[str]) -> None:
    """Raise a DataError for the words after ``aenerf`` if what they name is missing, or is in the way.

    Words that could mean something else are left to the parser of the arguments.
    """
    if not words or "--help" in words or "-h" in words:
        return
    command, *rest = words
    options = _options(rest)
    if command in _WRITES_FOLDER and "--output" in options:
        require_new(Path(options["--output"]))
    if command == "report":
        for run in takewhile(lambda word: not word.startswith("-"), rest):
            require_run(Path(run))
    if command in _WORKS_ON:
        option, require = _WORKS_ON[command]
        begins_with_word = bool(rest) and not rest[0].startswith("-") and rest[0] not in _formats()
        if begins_with_word != (option in options):
            require(Path(rest[0] if begins_with_word else options[option]))


def _options(words: Sequence[str]) -> dict[str, str]:
    """Return the values of options that have one value, and more that are never asked for."""
    options = {}
    for word, following in pairwise([*words, ""]):
        if word.startswith("--"):
            name, equals, value = word.partition("=")
            options[name.replace("_", "-")] = value if equals else following
    return options


def _formats() -> set[str]:
    """Return the names of the formats of datasets, which may come before the dataset."""
    return {"auto", *(entry.name for entry in entry_points(group="nerfstudio.dataparser_configs"))}
