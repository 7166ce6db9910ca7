"""Read the chunks of a PNG other than its pixels from the file's bytes: colour, place and metadata.

Pillow drops some of them (cICP, oFFs, caNv) and finds others only after it has decoded the pixels. PNG, third
edition: https://www.w3.org/TR/png-3/
"""

from __future__ import annotations

import struct
import zlib
from typing import IO

SIGNATURE = b"\x89PNG\r\n\x1a\n"
MOST_BYTES = 16 << 20
_WANTED = {b"cICP", b"gAMA", b"cHRM", b"sRGB", b"oFFs", b"caNv", b"eXIf", b"iTXt", b"zTXt", b"tEXt"}
_XMP = b"XML:com.adobe.xmp"
_RAW = b"Raw profile type "


def read_chunks(file: IO[bytes]) -> dict[bytes, bytes]:
    """Return the needed chunks by name.

    Metadata from text chunks is stored under b"xmp", b"exif" and b"iptc".

    Damaged chunks are left out.
    """
    found: dict[bytes, bytes] = {}
    file.seek(len(SIGNATURE))
    while len(head := file.read(8)) == 8:
        length, name = struct.unpack(">I4s", head)
        if name == b"IEND":
            break
        if name not in _WANTED or length > MOST_BYTES:
            file.seek(length + 4, 1)
            continue
        data, check = file.read(length), file.read(4)
        if len(data) < length or check != struct.pack(">I", zlib.crc32(name + data)):
            continue
        if name in (b"iTXt", b"zTXt", b"tEXt"):
            try:
                found.update(_text(name, data))
            except (ValueError, zlib.error):
                continue
        else:
            found.setdefault(name, data)
    if b"eXIf" in found:
        found[b"exif"] = found[b"eXIf"]
    return found


def raw_profile(name: str, data: bytes) -> bytes:
    """Return the text of ImageMagick's "Raw profile type", the only place for IPTC in a PNG."""
    digits = data.hex()
    lines = "\n".join(digits[i : i + 72] for i in range(0, len(digits), 72))
    return f"\n{name}\n{len(data):8d}\n{lines}\n".encode()


def _text(name: bytes, data: bytes) -> dict[bytes, bytes]:
    keyword, _, rest = data.partition(b"\0")
    if name == b"iTXt" and keyword == _XMP:
        compressed, rest = rest[0], rest[2:].split(b"\0", 2)[2]
        return {b"xmp": _inflate(rest) if compressed else rest}
    if not keyword.startswith(_RAW) or name == b"iTXt":
        return {}
    text = _inflate(rest[1:]) if name == b"zTXt" else rest
    kind = keyword.removeprefix(_RAW)
    content = bytes.fromhex("".join(text.decode("latin-1").split("\n")[3:]))
    if kind in (b"exif", b"APP1") and content.startswith((b"Exif", b"II", b"MM")):
        return {b"exif": content}
    if kind == b"iptc":
        return {b"iptc": content}
    return {}


def _inflate(data: bytes) -> bytes:
    unpacker = zlib.decompressobj()
    return unpacker.decompress(data, MOST_BYTES)
