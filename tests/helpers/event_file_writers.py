"""Write event files in the formats of cameras' vendors, from the descriptions of the formats."""

import struct
from collections.abc import Callable
from itertools import groupby

import numpy as np

WIDTH, HEIGHT = 64, 48

# Rows x, y, t in microseconds, p.
Rows = list[tuple[int, int, int, int]]


def evt2(rows: Rows) -> bytes:
    words, high = [], None
    for x, y, t, p in rows:
        if (t >> 6) != high:
            high = t >> 6
            words += [0x8 << 28 | high & 0xFFFFFFF] * 2
        words.append((p > 0) << 28 | (t & 0x3F) << 22 | x << 11 | y)
    header = f"% evt 2.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()
    return header + np.array(words, "<u4").tobytes()


def evt3_words(rows: Rows) -> np.ndarray:
    """Neighboring events of one time, row and polarity are vectors; in between are words without events."""
    words: list[int] = []
    last_high = None
    for (t, y, p), group in groupby(rows, lambda row: (row[2], row[1], row[3])):
        high = t >> 12 & 0xFFF
        if t >> 12 != last_high:
            last_high = t >> 12
            words += [0x8000 | high] * 2
        words += [0x6000 | t & 0xFFF, y, 0xA001, 0xE123, 0xF456, 0x7007]
        polarity = 0x800 if p > 0 else 0
        columns = [row[0] for row in group]
        while columns:
            base = columns[0]
            run = 1
            while run < len(columns) and columns[run - 1] < columns[run] < base + 32:
                run += 1
            if run == 1:
                words.append(0x2000 | polarity | base)
            else:
                mask = sum(1 << (column - base) for column in columns[:run])
                words += [0x3000 | polarity | base, 0x4000 | mask & 0xFFF, 0x4000 | mask >> 12 & 0xFFF]
                words.append(0x5000 | mask >> 24)
            columns = columns[run:]
    return np.array(words, "<u2")


def evt3(rows: Rows) -> bytes:
    return f"% evt 3.0\n% format EVT3;height={HEIGHT};width={WIDTH}\n".encode() + evt3_words(rows).tobytes()


def dat(rows: Rows) -> bytes:
    words = [word for x, y, t, p in rows for word in (t & 0xFFFFFFFF, (p > 0) << 28 | y << 14 | x)]
    header = f"% Data file containing CD events\n% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n".encode()
    return header + b"\x0c\x08" + np.array(words, "<u4").tobytes()


def flat_table(identifier: bytes, fields: list[bytes], vector: int, items: bytes, count: int) -> bytes:
    """A FlatBuffer of one table whose field number ``vector`` is a vector of items."""
    list_begin, table_begin = 8, 8 + (4 + 2 * len(fields) + 11) // 8 * 8
    size = 8 * (len(fields) + 1)
    places = [8 * (i + 1) for i in range(len(fields))]
    field_list = struct.pack(f"<{2 + len(fields)}H", 4 + 2 * len(fields), size, *places)
    body = struct.pack("<i", table_begin - list_begin).ljust(8, b"\0")
    # Items are aligned to 8 bytes: their number ends there.
    items_begin = table_begin + size + 4
    for i, field in enumerate(fields):
        value = struct.pack("<I", items_begin - (table_begin + places[i])) if i == vector else field
        body += value.ljust(8, b"\0")
    buffer = struct.pack("<I", table_begin) + identifier + field_list
    return buffer.ljust(table_begin, b"\0") + body + b"\0" * 4 + struct.pack("<I", count) + items


def sized(buffer: bytes) -> bytes:
    return struct.pack("<I", len(buffer)) + buffer


def aedat4_packet(rows: Rows) -> bytes:
    items = b"".join(struct.pack("<q2hB3x", t, x, y, p > 0) for x, y, t, p in rows)
    return sized(flat_table(b"EVTS", [b""], 0, items, len(rows)))


AEDAT4_SIZE = f'<attr key="sizeX" type="int">{WIDTH}</attr><attr key="sizeY" type="int">{HEIGHT}</attr>'


def aedat4_file(
    rows: Rows,
    compression: int = 0,
    compress: Callable[[bytes], bytes] = bytes,
    streams: dict[int, str] | None = None,
    size: str = AEDAT4_SIZE,
    with_table: bool = False,
) -> bytes:
    """Packets of three events, between packets of another stream; with an empty packet."""
    packets = [(1, b"frame")]
    for begin in range(0, len(rows), 3):
        packets += [(0, compress(aedat4_packet(rows[begin : begin + 3]))), (1, b"frame")]
    packets.insert(3, (0, compress(aedat4_packet([]))))
    body = b"".join(struct.pack("<2i", stream, len(data)) + data for stream, data in packets)
    nodes = "".join(
        f'<node name="{number}"><attr key="typeIdentifier" type="string">{kind}</attr>'
        f'<node name="info">{size}</node></node>'
        for number, kind in (streams or {0: "EVTS", 1: "FRME"}).items()
    )
    info = f'<dv version="2.0"><node name="outInfo">{nodes}</node></dv>'.encode()
    header_size = len(flat_table(b"IOHE", [b""] * 3, 2, info, len(info)))
    position = 14 + 4 + header_size + len(body) if with_table else -1
    fields = [struct.pack("<i", compression), struct.pack("<q", position), b""]
    header = flat_table(b"IOHE", fields, 2, info, len(info))
    # The table is not read: it may hold anything.
    return b"#!AER-DAT4.0\r\n" + sized(header) + body + (bytes(200) if with_table else b"")


ENCODERS = {"evt2": evt2, "evt3": evt3, "dat": dat, "aedat4": aedat4_file}


ROWS: Rows = [(x, 5 + x % 3, 100_000 + 1000 * x, 1 - 2 * (x % 2)) for x in range(30)]


HEADER2, HEADER3 = b"% evt 2.0\n% geometry 64x48\n", b"% evt 3.0\n% geometry 64x48\n"


def words(dtype: str, *values: int) -> bytes:
    return np.array(values, dtype).tobytes()


def evt3_of(*values: int) -> bytes:
    return HEADER3 + words("<u2", *values)
