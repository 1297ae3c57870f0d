"""Progress bars for long work."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sized
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Item = TypeVar("Item")
Chunk = TypeVar("Chunk", bound=Sized)


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


def tracked(chunks: Iterable[Chunk], description: str, total: int | None) -> Iterator[Chunk]:
    """Yield the chunks and show how much of them has been yielded.

    Args:
        chunks: pieces of a long whole, such as those of an event file.
        description: shown in front of the bar.
        total: length of all chunks together, or None where it is not known.
    """
    with progress_bar() as progress:
        task = progress.add_task(description, total=total)
        for chunk in chunks:
            yield chunk
            progress.advance(task, len(chunk))
