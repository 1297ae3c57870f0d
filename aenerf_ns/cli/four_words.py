"""Options of four numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import tyro


def four_words(number: Callable[[str], float], metavar: str) -> tyro.constructors.PrimitiveConstructorSpec[Any]:
    """Let an optional tuple take exactly four words: by itself, it would also take a dataset that follows."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=4,
        metavar=metavar,
        instance_from_str=lambda words: tuple(map(number, words)),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: [str(value)],
    )
