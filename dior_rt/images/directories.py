"""Read and write TIFF directories value by value. EXIF and TIFF files keep their tags in them.

Pillow's reader forgets the types of the values, and a viewer rejects a UserComment of the wrong type. Here
each value keeps its type and its bytes, in little-endian order. TIFF 6.0, section 2; BigTIFF, libtiff's
design.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO

import numpy as np

#: Bytes of one value, by type.
SIZES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
    17: 8,
    18: 8,
}
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED = 1, 2, 3, 4, 5, 7

MOST_ENTRIES = 4096
MOST_BYTES = 16 << 20  # of one value

_CODES = {1: "B", 2: "B", 3: "H", 4: "I", 6: "b", 7: "B", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I", 16: "Q"}


@dataclass(frozen=True)
class Entry:
    """One tag's value: its type, its number of values, and their bytes in little-endian order."""

    kind: int
    count: int
    data: bytes

    def numbers(self) -> tuple[float, ...]:
        """Return the values as numbers. A rational becomes a float, or 0 where its denominator is 0."""
        if self.kind in (5, 10):
            pairs = struct.unpack(f"<{self.count * 2}{'I' if self.kind == 5 else 'i'}", self.data)
            return tuple(a / b if b else 0.0 for a, b in zip(pairs[::2], pairs[1::2], strict=True))
        code = _CODES.get(self.kind)
        return struct.unpack(f"<{self.count}{code}", self.data) if code else ()

    def text(self) -> str:
        """Return the values as text, up to the first zero byte."""
        return self.data.partition(b"\0")[0].decode("latin-1").strip()


Directory = dict[int, Entry]


def number(directory: Mapping[int, Entry], tag: int, default: float = 0) -> float:
    """Return the first value of a tag, or the default where the tag is missing or holds no number."""
    values = directory[tag].numbers() if tag in directory else ()
    return values[0] if values else default


def entry(kind: int, *values: int | float | bytes) -> Entry:
    """Return an entry of whole numbers, rationals (passed as floats), or bytes."""
    if isinstance(values[0], bytes):
        return Entry(kind, len(values[0]), values[0])
    if kind == RATIONAL:
        parts = [part for value in values for part in (round(float(value) * 10000), 10000)]
        return Entry(kind, len(values), struct.pack(f"<{len(parts)}I", *parts))
    return Entry(kind, len(values), struct.pack(f"<{len(values)}{_CODES[kind]}", *values))


class Reader:
    """The directories of one TIFF structure.

    damaged: whether a value was left out because it lies outside the file or has an unknown type. first: the
    offset of the first directory. big: whether the file is a BigTIFF.
    """

    def __init__(self, file: IO[bytes] | bytes) -> None:
        """Read the header. Raises ValueError where there is none."""
        self._file = io.BytesIO(file) if isinstance(file, bytes) else file
        self.damaged = False
        head = self._read(0, 16)
        self._order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
        if not self._order or len(head) < 8:
            raise ValueError("it has no TIFF header")
        (magic,) = struct.unpack_from(self._order + "H", head, 2)
        self.big = magic == 43
        if self.big:
            self.first = int(struct.unpack(self._order + "Q", head[8:16])[0]) if len(head) == 16 else 0
        else:
            self.first = int(struct.unpack_from(self._order + "I", head, 4)[0])

    def directory(self, offset: int) -> tuple[Directory, int]:
        """Return the directory at an offset, and the offset of the next one (0 for none).

        A directory outside the file is empty.
        """
        word, size = ("Q", 20) if self.big else ("H", 12)
        counted = self._read(offset, 8 if self.big else 2)
        if len(counted) < (8 if self.big else 2):
            self.damaged = True
            return {}, 0
        count = struct.unpack(self._order + word, counted)[0]
        if count > MOST_ENTRIES:
            self.damaged = True
            return {}, 0
        body = self._read(offset + len(counted), count * size + (8 if self.big else 4))
        found: Directory = {}
        for start in range(0, min(count, len(body) // size) * size, size):
            tag, value = self._entry(body[start : start + size])
            if value is None:
                self.damaged = True
            else:
                found[tag] = value
        tail = body[count * size :]
        if len(tail) < (8 if self.big else 4):
            return found, 0
        return found, int(struct.unpack(self._order + ("Q" if self.big else "I"), tail)[0])

    def _entry(self, raw: bytes) -> tuple[int, Entry | None]:
        tag, kind, count = struct.unpack_from(self._order + ("HHQ" if self.big else "HHI"), raw)
        inline = raw[12:] if self.big else raw[8:]
        length = SIZES.get(kind, 0) * count
        if not length or length > MOST_BYTES:
            return tag, None
        if length > len(inline):
            offset = struct.unpack(self._order + ("Q" if self.big else "I"), inline)[0]
            data = self._read(offset, length)
        else:
            data = inline[:length]
        if len(data) < length:
            return tag, None
        if self._order == ">" and SIZES[kind] > 1:
            width = 4 if kind in (5, 10) else SIZES[kind]
            data = np.frombuffer(data, f">u{width}").astype(f"<u{width}").tobytes()
        return tag, Entry(kind, count, data)

    def _read(self, offset: int, size: int) -> bytes:
        if not 0 <= offset < 1 << 62:
            return b""
        self._file.seek(offset)
        return self._file.read(size)


def pack(
    directory: Mapping[int, Entry], children: Mapping[int, Mapping[int, Entry]], start: int = 8
) -> bytes:
    """Return a directory as it lies at the offset `start`, with the directories that some of its tags point
    at.
    """
    pointers = {tag: Entry(LONG, 1, bytes(4)) for tag, child in children.items() if child}
    entries = dict(sorted({**directory, **pointers}.items()))
    at = start + 2 + 12 * len(entries) + 4
    rows, body = b"", b""
    for tag, value in entries.items():
        data = value.data
        if tag in pointers:
            packed = pack(children[tag], {}, at + len(body))
            data = struct.pack("<I", at + len(body))
            body += packed + bytes(len(packed) % 2)
        elif len(data) > 4:
            inline = struct.pack("<I", at + len(body))
            body += data + bytes(len(data) % 2)
            data = inline
        rows += struct.pack("<HHI", tag, value.kind, value.count) + data.ljust(4, b"\0")
    return struct.pack("<H", len(entries)) + rows + bytes(4) + body


HEADER = b"II*\0\x08\0\0\0"
