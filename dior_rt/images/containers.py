"""Read what the file around the pixels states, format by format: metadata, colour, depth, pages and place."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import IO, Any

from PIL import Image

from dior_rt.images import primaries
from dior_rt.images.boxes import BoxFacts, read_boxes
from dior_rt.images.metadata import IPTC, Exif, read_exif
from dior_rt.images.png_chunks import read_chunks
from dior_rt.images.tiff_pages import read_facts as read_tiff

Size = tuple[int, int]


@dataclass(frozen=True)
class Facts:
    """The facts that the file around the pixels states.

    exif, xmp, iptc: as found. icc: the profile by which the pixels are read, b"" for sRGB. bits: a channel's
    depth where the file has more than is read, else 0. offset, canvas: the place of a cut-out picture,
    (right, down) on a canvas of (rows, columns), None where the file names none. lossy: whether packing
    changes pixels. turned: whether Pillow turns the picture upright itself, by EXIF. notices: sentences for
    the user.
    """

    exif: Exif = field(default_factory=Exif)
    xmp: bytes = b""
    iptc: bytes = b""
    icc: bytes = b""
    bits: int = 0
    offset: Size = (0, 0)
    canvas: Size | None = None
    lossy: bool = False
    turned: bool = False
    notices: tuple[str, ...] = ()


def read_facts(file: IO[bytes], image: Image.Image, page: int = 0) -> Facts:
    """Return the facts of a picture that Pillow has opened. Raises ValueError for HDR."""
    reader = {"PNG": _png, "TIFF": _tiff, "AVIF": _boxed, "JPEG2000": _boxed}.get(image.format or "", _plain)
    return reader(file, image, page)


def facts_of(image: Image.Image) -> Facts:
    """Return the facts of a loaded picture in memory, as far as Pillow passes them on."""
    info, is_tiff = image.info, image.format == "TIFF"
    exif = image.getexif().tobytes() if is_tiff else _bytes(info.get("exif"))
    icc = _bytes(info.get("icc_profile"))
    if not icc and "srgb" not in info and "gamma" in info:
        whole = [round(value * 100_000) for value in info.get("chromaticity", ())]
        xy = struct.pack(">8I", *whole) if len(whole) == 8 else b""
        icc = primaries.profile_of_png(struct.pack(">I", round(info["gamma"] * 100_000)), xy)
    return _common(info, exif, icc, turned=is_tiff)


def _common(info: dict[Any, Any], exif: bytes, icc: bytes, **more: Any) -> Facts:
    found = read_exif(exif)
    if not icc and found.is_adobe_rgb:
        icc = primaries.adobe_rgb_profile()
    resources = info.get("photoshop")
    iptc = _bytes(resources.get(IPTC)) if isinstance(resources, dict) else b""
    return Facts(found, _bytes(info.get("xmp")), **({"iptc": iptc} | more), icc=icc)


def _plain(file: IO[bytes], image: Image.Image, page: int) -> Facts:
    info = image.info
    lossy = image.format in ("JPEG", "MPO") or (image.format == "WEBP" and not _is_lossless_webp(file))
    return _common(info, _bytes(info.get("exif")), _bytes(info.get("icc_profile")), lossy=lossy)


def _png(file: IO[bytes], image: Image.Image, page: int) -> Facts:
    chunks = read_chunks(file)
    icc = _bytes(image.info.get("icc_profile"))
    notices: tuple[str, ...] = ()
    code = chunks.get(b"cICP", b"")
    if len(code) == 4:  # cICP overrides a profile, and a profile overrides sRGB, gAMA and cHRM
        icc = primaries.profile_of_codes(code[0], code[1])
    elif not icc and b"sRGB" not in chunks:
        try:
            icc = primaries.profile_of_png(chunks.get(b"gAMA", b""), chunks.get(b"cHRM", b""))
        except ValueError:
            notices = ("Its gamma or primaries are damaged; it is read as sRGB.",)
    offset, canvas = (0, 0), None
    if len(place := chunks.get(b"oFFs", b"")) == 9 and place[8] == 0:
        offset = struct.unpack(">2i", place[:8])
    if len(frame := chunks.get(b"caNv", b"")) >= 16:
        width, height, x, y = struct.unpack(">2I2i", frame[:16])
        canvas, offset = (height, width), (x, y)
    return _common(
        image.info,
        chunks.get(b"exif", b""),
        icc,
        iptc=chunks.get(b"iptc", b""),
        offset=offset,
        canvas=canvas,
        notices=notices,
    )


def _tiff(file: IO[bytes], image: Image.Image, page: int) -> Facts:
    tiff = read_tiff(file, page)
    icc = _bytes(image.info.get("icc_profile"))
    if not icc and tiff.exif.is_adobe_rgb:
        icc = primaries.adobe_rgb_profile()
    is_layer = tiff.pages > 1 and (tiff.offset != (0, 0) or image.size[::-1] != tiff.size)
    return Facts(
        tiff.exif,
        _bytes(image.info.get("xmp")),
        tiff.iptc,
        icc,
        offset=tiff.offset if is_layer else (0, 0),
        canvas=tiff.size if is_layer else None,
        lossy=tiff.lossy,
        turned=True,
    )


def _boxed(file: IO[bytes], image: Image.Image, page: int) -> Facts:
    try:
        boxes = read_boxes(file)
    except struct.error:
        boxes = BoxFacts()
    icc = _bytes(image.info.get("icc_profile")) or boxes.icc
    if not icc and boxes.cicp:
        icc = primaries.profile_of_codes(*boxes.cicp[:2])
    bits = boxes.bits if boxes.bits > 8 and not image.mode.startswith("I;16") else 0
    return _common(image.info, _bytes(image.info.get("exif")), icc, bits=bits, lossy=True)


def _is_lossless_webp(file: IO[bytes]) -> bool:
    file.seek(12)
    while len(head := file.read(8)) == 8:
        name, size = struct.unpack("<4sI", head)
        if name in (b"VP8L", b"VP8 "):
            return name == b"VP8L"
        file.seek(size + size % 2, 1)
    return False


def _bytes(value: Any) -> bytes:
    if isinstance(value, str):
        return value.encode()
    return value if isinstance(value, bytes) else b""
