"""Read the facts of a TIFF's pages from its tags: kinds and depths that Pillow misreads, and a page's
place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import IO

from dior_rt.images.directories import Directory, Reader, number
from dior_rt.images.metadata import IPTC_TAG, Exif, exif_of

MOST_PAGES = 1000

_NEW_SUBFILE, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _MAKE = 254, 256, 257, 258, 259, 262, 271
_SAMPLES, _X_DPI, _Y_DPI, _UNIT, _X, _Y, _SUB_IFDS, _FORMAT = 277, 282, 283, 296, 286, 287, 330, 339
_DNG_VERSION = 50706
_LOSSY = (6, 7, 34892, 34933, 50001, 50002)  # JPEG, lossy DNG, WebP, JPEG XL
_FILTERS = (32803, 34892)  # photometric: a colour filter's mosaic, linear raw
_MAKERS = ("nikon", "canon", "sony", "pentax", "samsung", "hasselblad", "phase one", "leaf", "kodak", "epson")


@dataclass(frozen=True)
class TiffFacts:
    """The facts of a TIFF and one of its pages.

    pages: the number of pages. size: (rows, columns) of the first page. offset: the page's place in pixels,
    right and down. exif, iptc: those of the page. is_raw: whether it is a camera's raw file. depth: a
    description of its samples, where they cannot be read. lossy: whether its compression changes pixels.
    """

    pages: int
    size: tuple[int, int]
    offset: tuple[int, int]
    exif: Exif
    iptc: bytes
    is_raw: bool
    depth: str
    lossy: bool


def read_facts(file: IO[bytes], page: int = 0) -> TiffFacts:
    """Return the facts of a page (0 is the first). A page beyond the last has the facts of an empty one.

    Raises ValueError for a file without a TIFF header.
    """
    reader = Reader(file)
    pages: list[tuple[int, Directory]] = []
    offset, seen = reader.first, set[int]()
    while offset and offset not in seen and len(pages) < MOST_PAGES:
        seen.add(offset)
        directory, following = reader.directory(offset)
        if not directory:
            break
        pages.append((offset, directory))
        offset = following
    if not pages:
        raise ValueError("it has no picture in it, or it is damaged")
    at, tags = pages[min(page, len(pages) - 1)]
    first = pages[0][1]
    iptc = tags[IPTC_TAG].data if IPTC_TAG in tags else b""
    return TiffFacts(
        len(pages),
        (int(number(first, _HEIGHT)), int(number(first, _WIDTH))),
        _place(tags),
        exif_of(reader, at),
        iptc,
        _is_raw(reader, first),
        _unreadable_depth(tags),
        int(number(tags, _COMPRESSION, 1)) in _LOSSY,
    )


def _is_raw(reader: Reader, first: Directory) -> bool:
    if _DNG_VERSION in first or number(first, _PHOTOMETRIC, 2) in _FILTERS:
        return True
    inner = [int(at) for at in first[_SUB_IFDS].numbers()[:16]] if _SUB_IFDS in first else []
    children = [reader.directory(at)[0] for at in inner]
    if any(number(child, _PHOTOMETRIC, 2) in _FILTERS for child in children):
        return True
    is_preview = int(number(first, _NEW_SUBFILE)) & 1
    has_main = any(child and not int(number(child, _NEW_SUBFILE)) & 1 for child in children)
    from_camera = _MAKE in first and first[_MAKE].text().lower().startswith(_MAKERS)
    return bool(is_preview and (has_main or from_camera))


def _place(tags: Directory) -> tuple[int, int]:
    """Return a page's offset in pixels. Its position is stored in the unit of the resolution."""
    across = number(tags, _X) * number(tags, _X_DPI, 1)
    down = number(tags, _Y) * number(tags, _Y_DPI, 1)
    return round(across), round(down)


def _unreadable_depth(tags: Directory) -> str:
    """Describe the samples where neither Pillow nor `sixteen_bit` reads them correctly, else return ""."""
    bits = int(max(tags[_BITS].numbers(), default=1)) if _BITS in tags else 1
    kind = int(max(tags[_FORMAT].numbers(), default=1)) if _FORMAT in tags else 1
    photometric = int(number(tags, _PHOTOMETRIC, 1))
    if kind == 3:
        return f"{bits}-bit floating-point samples"
    if kind in (5, 6):
        return "complex samples"
    if kind == 2:
        return f"signed {bits}-bit samples"
    if bits > 16:
        return f"{bits}-bit samples"
    if bits > 8 and photometric in (8, 9, 10):
        return f"{bits}-bit Lab colours"
    if bits not in (1, 2, 4, 8, 16) and photometric == 2:
        return f"{bits}-bit samples"
    return ""
