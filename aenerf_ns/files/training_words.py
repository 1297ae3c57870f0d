"""The dataset on the command line of ``ns-train``, judged before the framework has imported all of its methods."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

from aenerf_ns.errors import errors_as_one_line
from aenerf_ns.files.layouts import look_over
from aenerf_ns.files.output_paths import require_dataset

_PROGRAMS = ("ns-train", "ns-train.exe", "ns-train-script.py")


def judge_training(words: Sequence[str]) -> None:
    """Judge the dataset of a training by a method of this package. Other commands and methods are left alone.

    Args:
        words: the command line, with the program's name.

    Raises:
        SystemExit: with one line, if the dataset is missing, of no known format, or malformed.
    """
    if len(words) < 2 or Path(words[0]).name not in _PROGRAMS or {"-h", "--help"} & set(words):
        return
    methods = entry_points(group="nerfstudio.method_configs")
    if words[1] not in {method.name for method in methods if method.value.startswith("aenerf_ns.")}:
        return
    data = _data(words)
    # With --load-config, the run's own configuration names the format.
    if data is None or any(word.startswith("--load") for word in words):
        return
    named = {parser.name for parser in entry_points(group="nerfstudio.dataparser_configs")} - {"event-data"}
    with errors_as_one_line():
        (require_dataset if named & set(words) else look_over)(data)


def _data(words: Sequence[str]) -> Path | None:
    """Return the value of ``--data``, or None where it is not given exactly once."""
    given = [
        value if equals else following
        for word, following in zip(words, [*words[1:], ""], strict=True)
        for name, equals, value in [word.partition("=")]
        if name == "--data"
    ]
    return Path(given[0]) if len(given) == 1 and given[0] else None
