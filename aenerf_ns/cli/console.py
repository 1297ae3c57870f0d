"""How commands print."""

from __future__ import annotations

from nerfstudio.utils.rich_utils import CONSOLE


def say(text: str) -> None:
    """Print a text as it is: paths and numbers are neither colored, nor taken for markup, nor broken into lines."""
    CONSOLE.print(text, highlight=False, markup=False, soft_wrap=True)
