"""The text at the beginning of Prophesee's RAW and DAT files.

https://docs.prophesee.ai/stable/data/file_formats/raw.html
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.stream import require_event_file

# Far more bytes than any header has.
_MAX_BYTES = 1 << 16


@dataclass(frozen=True)
class PropheseeHeader:
    """The lines ``% keyword value`` of a header.

    Attributes:
        fields: values by keyword in lower case.
        end: number of bytes before the events.
    """

    fields: dict[str, str]
    end: int

    @property
    def format_options(self) -> dict[str, str]:
        """Return the options of ``% format NAME;option=value;…``, and its name in capitals as the option "name"."""
        name, *options = self.fields.get("format", "").split(";")
        pairs = (option.partition("=") for option in options)
        return {"name": name.strip().upper(), **{key.strip().lower(): value.strip() for key, _, value in pairs}}

    @property
    def size(self) -> tuple[int, int] | None:
        """Return the width and height of the sensor in pixels, or None where the header does not tell them."""
        geometry = re.fullmatch(r"(\d{1,9})\s*x\s*(\d{1,9})", self.fields.get("geometry", ""))
        if geometry:
            return int(geometry[1]), int(geometry[2])
        for source in (self.format_options, self.fields):
            sizes = [source.get(name, "") for name in ("width", "height")]
            if all(re.fullmatch(r"\d{1,9}", size) for size in sizes):
                return int(sizes[0]), int(sizes[1])
        return None


def read_header(path: Path) -> PropheseeHeader:
    """Read the header of a RAW or DAT file.

    Raises:
        DataError: the file is missing or has no such header.
    """
    require_event_file(path)
    with reading(path), path.open("rb") as file:
        text = file.read(_MAX_BYTES)
    fields: dict[str, str] = {}
    end = 0
    # The keyword "end" is optional. Without it, the header ends at the first line that does not begin with "% ".
    while text.startswith(b"% ", end):
        line_end = text.find(b"\n", end) + 1
        if line_end == 0:
            raise DataError(path, f"line {len(fields) + 1} of its header does not end", "record or copy it again")
        keyword, _, value = text[end + 2 : line_end].decode("ascii", "replace").strip().partition(" ")
        end = line_end
        if keyword.lower() == "end":
            break
        fields[keyword.lower()] = value.strip()
    if end == 0:
        raise DataError(
            path, 'it does not begin with the header of a Prophesee file ("% ...")', "check what kind of file it is"
        )
    return PropheseeHeader(fields, end)
