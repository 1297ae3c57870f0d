"""Decompress pieces of files with a limit, which the libraries' own functions for whole pieces do not have."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Any

# Pieces of bags and of AEDAT4 files have some megabytes.
MAX_PIECE = 1 << 27
"""The most bytes of a piece, compressed or not."""


def unpacked(data: bytes, compression: str, max_bytes: int = MAX_PIECE) -> bytes:
    """Return the decompressed bytes of a piece.

    Args:
        data: the piece.
        compression: bz2, lz4 or zstd.
        max_bytes: the most bytes that it may have.

    Raises:
        ImportError: the package for this compression is missing.
        ValueError: the piece is damaged, cut or too large.
    """
    decompressor = _decompressor(compression)()
    try:
        content = decompressor.decompress(data, max_length=max_bytes)
    # Each library raises its own errors.
    except Exception as error:
        raise ValueError(f"it cannot be decompressed ({error})") from None
    if not decompressor.eof:
        raise ValueError(f"it is cut, or has more than {max_bytes:,} bytes when it is decompressed")
    return content


def require_unpacker(compression: str) -> None:
    """Raise an ImportError if the package for a compression is missing."""
    _decompressor(compression)


def _decompressor(compression: str) -> Callable[[], Any]:
    if compression == "bz2":
        return bz2.BZ2Decompressor
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor
    from backports.zstd import ZstdDecompressor

    return ZstdDecompressor
