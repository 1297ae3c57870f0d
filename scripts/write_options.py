"""Write docs/options.md: every option of the methods and of the dataset formats, with its default.

Run ``python scripts/write_options.py`` after changing an option, a default or the docstring of an option.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

import tyro

# tyro reads the docstrings that follow fields. ns-train shows the same texts as its help.
from tyro._docstrings import get_field_docstring

from aenerf_ns.dataparsers.formats import FORMATS
from aenerf_ns.method_configs import peers
from aenerf_ns.method_configs.aenerf import aenerf, aenerf_small
from aenerf_ns.method_configs.aenerf_mlp import aenerf_mlp, aenerf_mlp_small

PAGE = Path(__file__).parents[1] / "docs" / "options.md"

METHODS = {method.config.method_name: method.config for method in (aenerf, aenerf_small, aenerf_mlp, aenerf_mlp_small)}
# Only the options in which they differ from AE-NeRF of the same size are listed.
PEERS = {
    f"{name}{size}": getattr(peers, f"{name}{size}".replace("-", "_")).config
    for name in ("robust-enerf", "eventnerf", "evnerf", "paev3d", "e2vid-nerf")
    for size in ("", "-small")
}

# Nerfstudio's options are listed where a method changes their default. These are listed because many runs set them.
OFTEN_SET = {"--machine.seed", "--machine.device-type", "--machine.num-devices", "--mixed-precision", "--load-dir"}
# Defaults that depend on the machine.
DEFAULTS_IN_WORDS = {"--machine.device-type": "cuda, or cpu without a GPU"}
# These differ from Nerfstudio's default, but they are no choice of the user.
NO_CHOICE = {"--method-name", "--logging.local-writer.enable"}

SECTIONS = {
    "--pipeline.model.": "The model",
    "--pipeline.datamanager.": "Batches",
    "--pipeline.": "The pipeline",
    "--optimizers.": "Learning rates",
    "--": "Training",
}

INTRODUCTION = """\
# Options

This page lists this project's options of `ns-train` and of the dataset formats, with their defaults. `ns-train METHOD
--help` also lists Nerfstudio's own options; [some of them have no effect](nerfstudio.md#commands-and-flags). [The
method](method.md) explains the terms. Give `True` or `False` after an option whose default is one of them.

`python scripts/write_options.py` writes this page from the configurations: do not edit it by hand.
"""

PEERS_INTRODUCTION = """\
## Methods of other papers

Options of `aenerf` that are not in this table have the same defaults in [these
methods](supervision.md#methods-of-other-papers), and options of
`aenerf-small` in the small ones. Only `robust-enerf` has
options of pairs and of the sensor.
"""

FORMAT_INTRODUCTION = """\
## Dataset formats

Give an option of a dataset format after the format's name, at the end of the command:
`ns-train aenerf --data FOLDER ecd-data --scale-factor 2`.
"""


def options_page() -> str:
    """Return the text of docs/options.md."""
    values, meanings = _values_and_meanings(METHODS)
    parts = [INTRODUCTION]
    # A flag belongs to the first section whose prefix it has.
    sections: dict[str, list[str]] = {title: [] for title in SECTIONS.values()}
    for flag, meaning in meanings.items():
        title = next(title for prefix, title in SECTIONS.items() if flag.startswith(prefix))
        defaults = [_code(values[flag][method]) if method in values[flag] else "" for method in METHODS]
        sections[title].append(_row(f"`{flag}`", *defaults, meaning))
    for title, rows in sections.items():
        if rows:
            parts.append(f"## {title}\n")
            parts.append(_table(["option", *(f"`{method}`" for method in METHODS), "meaning"], rows))
    parts += [PEERS_INTRODUCTION, _table(["option", *(f"`{name}`" for name in PEERS), "meaning"], list(_peer_rows()))]
    parts.append(FORMAT_INTRODUCTION)
    parts.append(_table(["option", "formats", "default", "meaning"], list(_format_rows())))
    return "\n".join(parts)


def _values_and_meanings(methods: dict[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Return the default of each method by flag, and the meanings of the flags that the page lists."""
    values: dict[str, dict[str, Any]] = {}
    meanings: dict[str, str] = {}
    for method, config in methods.items():
        offered = _offered(config)
        for flag, value, is_listed, meaning in _options(config):
            values.setdefault(flag, {})[method] = value
            if is_listed and flag in offered:
                meanings.setdefault(flag, meaning)
    return values, meanings


def _peer_rows() -> Iterator[str]:
    """Yield a row for each option in which a peer differs from AE-NeRF of the same size."""
    ours, _ = _values_and_meanings(METHODS)
    values, meanings = _values_and_meanings(PEERS)
    for flag, meaning in meanings.items():
        twins = {name: "aenerf-small" if name.endswith("-small") else "aenerf" for name in values[flag]}
        if any(value != ours.get(flag, {}).get(twins[name]) for name, value in values[flag].items()):
            cells = [_code(values[flag][name]) if name in values[flag] else "" for name in PEERS]
            yield _row(f"`{flag}`", *cells, meaning)


def _format_rows() -> Iterator[str]:
    """Yield a row for each option of the dataset formats, and one for each of its defaults and meanings."""
    formats_with: dict[tuple[str, str, str], list[str]] = {}
    for name, config in FORMATS.items():
        for flag, value, is_listed, meaning in _options(config):
            if is_listed:
                formats_with.setdefault((flag, _code(value), meaning), []).append(f"`{name}`")
    flags = list(dict.fromkeys(flag for flag, _, _ in formats_with))
    for (flag, value, meaning), names in sorted(formats_with.items(), key=lambda item: flags.index(item[0][0])):
        others = [f"`{name}`" for name in FORMATS if f"`{name}`" not in names]
        formats = "all" if not others else f"all but {', '.join(others)}" if len(others) < 3 else ", ".join(names)
        yield _row(f"`{flag}`", formats, value, meaning)


def _offered(config: Any) -> set[str]:
    """Return the flags that ``ns-train`` offers for a configuration."""
    parser = tyro.extras.get_parser(type(config), default=config)
    return {flag for action in parser._actions for flag in action.option_strings}


def _options(config: Any, prefix: str = "--") -> Iterator[tuple[str, Any, bool, str]]:
    """Yield flag, default, whether the page lists it, and meaning of every option; nested configurations last."""
    nested = []
    for option in fields(config):
        value = getattr(config, option.name)
        flag = prefix + option.name.replace("_", "-")
        if option.name == "_target":
            continue
        is_listed = flag in OFTEN_SET or (flag not in NO_CHOICE and _is_listed(config, option))
        meaning = " ".join((get_field_docstring(type(config), option.name, ()) or "").split())
        if is_dataclass(value) or (isinstance(value, dict) and value):
            nested.append((value, flag, is_listed, meaning))
        else:
            yield flag, DEFAULTS_IN_WORDS.get(flag, value), is_listed, meaning
    for value, flag, is_listed, meaning in nested:
        if isinstance(value, dict):
            yield from _entries(value, flag, is_listed, meaning)
        else:
            yield from _options(value, f"{flag}.")


def _entries(values: dict[str, Any], flag: str, is_listed: bool, meaning: str) -> Iterator[tuple[str, Any, bool, str]]:
    """Yield the same as :func:`_options` for a dictionary of options, such as the optimizers."""
    for key, value in values.items():
        entry = f"{flag}.{key.replace('_', '-')}"
        if isinstance(value, dict):
            yield from _entries(value, entry, is_listed, meaning)
        elif is_dataclass(value):
            yield from _options(value, f"{entry}.")
        else:
            yield entry, value, is_listed, meaning


def _is_listed(config: Any, option: Field) -> bool:
    """Return whether an option is this project's own, or has another default here than in Nerfstudio."""
    owner = next(cls for cls in type(config).__mro__ if option.name in vars(cls).get("__annotations__", {}))
    if owner.__module__.startswith("aenerf_ns."):
        return True
    default = option.default if option.default_factory is MISSING else option.default_factory()
    return default is not MISSING and getattr(config, option.name) != default


def _code(value: Any) -> str:
    """Return a default as users type it."""
    text = " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
    return f"`{text}`" if text else ""


def _table(header: list[str], rows: list[str]) -> str:
    return "\n".join([_row(*header), _row(*("---" for _ in header)), *rows]) + "\n"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(options_page(), encoding="utf-8")
    print(f"Wrote {PAGE}")
