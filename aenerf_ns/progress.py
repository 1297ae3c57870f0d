"""Progress bars for long work."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Item = TypeVar("Item")


def progress_bar() -> Progress:
    """Return a progress bar with counts, elapsed and remaining time, which is cleared when it is done."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        transient=True,
    )


def track(items: Collection[Item], description: str) -> Iterator[Item]:
    """Yield items and show how many of them have been yielded and worked on."""
    with progress_bar() as progress:
        yield from progress.track(items, description=description)
