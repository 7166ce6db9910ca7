"""Carry over a picture's EXIF, XMP and IPTC, and write the settings that made the result.

EXIF keeps the tags that remain true of the relit photo. It drops the orientation (already applied), sizes and
thumbnail (stale), and the maker's note (its inner offsets break when it is moved). The settings are stored in
XMP, and in a PNG also as text. The photographer's UserComment is left alone.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base

from dior_rt.errors import InputError
from dior_rt.files import check_readable
from dior_rt.images import xmp
from dior_rt.images.directories import HEADER, UNDEFINED, Directory, Entry, Reader, number, pack

#: The errors that Pillow may raise for a damaged file.
DAMAGE = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    ArithmeticError,
    LookupError,
    TypeError,
    AttributeError,
    RuntimeError,
    struct.error,
)

KEY = "Dior"

IPTC = 0x0404  # the number of IPTC's block among Photoshop's resources
IPTC_TAG, XMP_TAG = 33723, 700  # of TIFF

_KEPT = {
    Base.ImageDescription,
    Base.Make,
    Base.Model,
    Base.Software,
    Base.DateTime,
    Base.Artist,
    Base.HostComputer,
    Base.Copyright,
    Base.Rating,
    Base.XPTitle,
    Base.XPComment,
    Base.XPAuthor,
    Base.XPKeywords,
    Base.XPSubject,
}
_STALE = {Base.MakerNote, Base.ExifInteroperabilityOffset, Base.ExifImageWidth, Base.ExifImageHeight}
#: Tags that EXIF defines as UNDEFINED, but that some programs (such as Pillow) write as BYTE.
_UNDEFINED = {36864, 37121, 37500, 37510, 40960, 41728, 41729, 41730, 27, 28}
_UNCALIBRATED = 65535
_HEAD = b"Exif\0\0"


@dataclass(frozen=True)
class Exif:
    """A picture's EXIF by directory. damaged: whether a part of it could not be read."""

    main: Directory = field(default_factory=dict)
    camera: Directory = field(default_factory=dict)
    place: Directory = field(default_factory=dict)
    interoperability: Directory = field(default_factory=dict)
    damaged: bool = False

    @property
    def orientation(self) -> int:
        """Return how to turn the picture upright, 1 to 8, or 1 where the tag makes no sense."""
        value = number(self.main, Base.Orientation, 1)
        return int(value) if value in range(1, 9) else 1

    @property
    def is_adobe_rgb(self) -> bool:
        """Return whether DCF's mark "R03" states Adobe RGB, the only such mark that comes without an ICC
        profile.
        """
        space = number(self.camera, Base.ColorSpace, _UNCALIBRATED)
        mark = self.interoperability.get(1)
        return space == _UNCALIBRATED and mark is not None and mark.text() == "R03"

    def kept(self) -> bytes:
        """Return the part that remains true of the relit photo, as bytes to write, or b"" for none."""
        main = {tag: value for tag, value in self.main.items() if tag in _KEPT}
        camera = {tag: _typed(tag, value) for tag, value in self.camera.items() if tag not in _STALE}
        place = {tag: _typed(tag, value) for tag, value in self.place.items()}
        if not (main or camera or place):
            return b""
        return _HEAD + HEADER + pack(main, {IFD.Exif: camera, IFD.GPSInfo: place})


def read_exif(data: bytes) -> Exif:
    """Return the EXIF in the bytes that a JPEG, PNG, WebP or AVIF holds. Damaged parts are left out."""
    if not data:
        return Exif()
    try:
        return exif_of(Reader(data.removeprefix(_HEAD)))
    except (ValueError, struct.error):
        return Exif(damaged=True)


def exif_of(reader: Reader, offset: int | None = None) -> Exif:
    """Return the EXIF of the directory at an offset, or of the first directory where none is named."""
    main, _ = reader.directory(reader.first if offset is None else offset)
    found = []
    for directory, pointer in ((main, IFD.Exif), (main, IFD.GPSInfo)):
        at = int(number(directory, pointer))
        found.append(reader.directory(at)[0] if at else {})
    camera, place = found
    at = int(number(camera, Base.ExifInteroperabilityOffset))
    interoperability = reader.directory(at)[0] if at else {}
    return Exif(main, camera, place, interoperability, reader.damaged)


def directories_of(exif: bytes) -> tuple[Directory, dict[int, Directory]]:
    """Return the directories of written EXIF for a TIFF: the main one, and the others by the tag that points
    at them.
    """
    parts = read_exif(exif)
    main = {tag: value for tag, value in parts.main.items() if tag not in (IFD.Exif, IFD.GPSInfo)}
    return main, {IFD.Exif: parts.camera, IFD.GPSInfo: parts.place}


def _typed(tag: int, value: Entry) -> Entry:
    return Entry(UNDEFINED, value.count, value.data) if tag in _UNDEFINED and value.kind == 1 else value


def photoshop_block(iptc: bytes) -> bytes:
    """Return the JPEG segment (APP13) that holds IPTC."""
    block = b"8BIM" + struct.pack(">HHI", IPTC, 0, len(iptc)) + iptc + bytes(len(iptc) % 2)
    data = b"Photoshop 3.0\0" + block
    return b"\xff\xed" + struct.pack(">H", len(data) + 2) + data


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a picture that this program wrote. Raises InputError where there are none."""
    check_readable(path, "picture")
    try:
        with Image.open(path) as image:
            image.load()
            text = image.info.get(KEY) or xmp.read_settings(image.info["xmp"])
            settings = json.loads(text)
            if not isinstance(settings, dict):
                raise ValueError
            return settings
    except (*DAMAGE, MemoryError) as error:
        raise InputError(f"{path} does not say how it was made.") from error


def read_dpi(info: Mapping[Any, Any]) -> tuple[float, float] | None:
    """Return dots per inch across and down from Pillow's info, or None where they are missing or make no
    sense.
    """
    try:
        across, down = (float(value) for value in info["dpi"])
    except (KeyError, ValueError, TypeError, ArithmeticError):
        return None
    return (across, down) if all(math.isfinite(v) and 0 < v < 65536 for v in (across, down)) else None
