"""Read depth and colour from the boxes of an AVIF or a JPEG 2000 file. Pillow does not pass these on.

The boxes are specified in ISO 14496-12 (boxes), 23000-22 (colr, nclx), AV1-ISOBMFF (av1C), and ITU-T T.800
annex I (ihdr, colr).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

_NESTED = {b"meta": 4, b"iprp": 0, b"ipco": 0, b"jp2h": 0}  # bytes of each before the boxes inside
MOST_BYTES = 16 << 20


@dataclass(frozen=True)
class BoxFacts:
    """The facts that the boxes state.

    bits: the bits of a channel, 0 where unknown. cicp: primaries, transfer and matrix of ITU-T H.273. icc:
    the profile, b"" where there is none.
    """

    bits: int = 0
    cicp: tuple[int, int, int] | None = None
    icc: bytes = b""


def read_boxes(file: IO[bytes]) -> BoxFacts:
    """Return the facts of an AVIF or JPEG 2000 file. Damaged boxes are left out."""
    file.seek(0)
    head = file.read(12)
    if head.startswith(b"\xff\x4f\xff\x51"):  # a bare JPEG 2000 codestream: its size marker comes first
        file.seek(0)
        return BoxFacts(bits=_codestream_bits(file.read(64)))
    bits, cicp, icc = 0, None, b""
    for name, data in _walk(file, 0, _size(file), 0):
        if name == b"av1C" and len(data) >= 4:
            bits = max(
                bits, (8, 10, 12)[min(2, (data[2] >> 6 & 1) + (data[2] >> 5 & 1 if data[2] >> 6 & 1 else 0))]
            )
        elif name == b"ihdr" and len(data) >= 11 and data[10] != 255:
            bits = max(bits, (data[10] & 127) + 1)
        elif name == b"colr" and data[:4] == b"nclx" and len(data) >= 10 and cicp is None:
            cicp = struct.unpack_from(">3H", data, 4)
        elif name == b"colr" and data[:1] == b"\x02":
            icc = icc or data[3:]
    return BoxFacts(bits, cicp, icc)


def _codestream_bits(head: bytes) -> int:
    """Return the bits of the first component from the SIZ marker, which comes first."""
    return (head[42] & 127) + 1 if len(head) > 42 else 0


def _walk(file: IO[bytes], start: int, stop: int, depth: int) -> Iterator[tuple[bytes, bytes]]:
    while start + 8 <= stop:
        file.seek(start)
        size, name = struct.unpack(">I4s", file.read(8))
        begin = start + 8
        if size == 1:
            wide = file.read(8)
            size = struct.unpack(">Q", wide)[0] if len(wide) == 8 else 0
            begin += 8
        end = stop if size == 0 else start + size
        if end > stop or end < begin:
            return
        if name in _NESTED and depth < 4:
            yield from _walk(file, begin + _NESTED[name], end, depth + 1)
        elif name in (b"av1C", b"colr", b"ihdr") and end - begin <= MOST_BYTES:
            file.seek(begin)
            yield name, file.read(end - begin)
        start = end


def _size(file: IO[bytes]) -> int:
    return file.seek(0, 2)
