"""What a picture says about itself: EXIF carried over from the photo, and the settings that made the result.

Of EXIF is kept what stays true of the relit photo. Left out are the orientation (carried out), sizes and
thumbnail (stale), and the maker's note (its inner offsets break when it is moved).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base

from dior_rt.errors import InputError
from dior_rt.files import check_readable

#: What a damaged file makes Pillow raise, here and there.
DAMAGE = (OSError, ValueError, SyntaxError, EOFError, ArithmeticError, LookupError, TypeError, AttributeError)

KEY = "Dior"

_KEPT = (
    *(
        Base.ImageDescription,
        Base.Make,
        Base.Model,
        Base.Software,
        Base.DateTime,
        Base.Artist,
        Base.HostComputer,
    ),
    *(
        Base.Copyright,
        Base.Rating,
        Base.XPTitle,
        Base.XPComment,
        Base.XPAuthor,
        Base.XPKeywords,
        Base.XPSubject,
    ),
)
_STALE = (Base.MakerNote, Base.ExifInteroperabilityOffset, Base.ExifImageWidth, Base.ExifImageHeight)
_ASCII = b"ASCII\0\0\0"  # the character code that opens a UserComment


def keep_exif(exif: Image.Exif) -> bytes:
    """The part of a photo's EXIF that its relit twin keeps; b"" for none. Raises one of DAMAGE."""
    kept = Image.Exif()
    for tag in _KEPT:
        if tag in exif:
            kept[tag] = exif[tag]
    camera = {tag: value for tag, value in exif.get_ifd(IFD.Exif).items() if tag not in _STALE}
    for ifd, values in ((IFD.Exif, camera), (IFD.GPSInfo, exif.get_ifd(IFD.GPSInfo))):
        if values:
            kept.get_ifd(ifd).update(values)
    written = kept.tobytes()
    return written if any(True for _ in kept) or camera or exif.get_ifd(IFD.GPSInfo) else b""


def stamp(exif: bytes, settings: Mapping[str, Any]) -> Image.Exif:
    """EXIF with the settings as JSON {"Dior": {...}} in its UserComment."""
    stamped = Image.Exif()
    stamped.load(exif)
    stamped.get_ifd(IFD.Exif)[Base.UserComment] = _ASCII + json.dumps({KEY: settings}).encode()
    return stamped


def read_settings(path: Path) -> dict[str, Any]:
    """The settings in a picture that was written here; InputError where there are none."""
    check_readable(path, "picture")
    try:
        with Image.open(path) as image:
            if image.format == "PNG":
                image.load()
                return json.loads(image.info[KEY])
            comment = image.getexif().get_ifd(IFD.Exif)[Base.UserComment]
            return json.loads(comment.removeprefix(_ASCII))[KEY]
    except DAMAGE as error:
        raise InputError(f"{path} does not say how it was made.") from error


def read_dpi(info: Mapping[Any, Any]) -> tuple[float, float] | None:
    """Dots an inch across and down by Pillow's info; None where they are not given or make no sense."""
    try:
        across, down = (float(value) for value in info["dpi"])
    except (KeyError, ValueError, TypeError, ArithmeticError):
        return None
    return (across, down) if all(math.isfinite(v) and 0 < v < 65536 for v in (across, down)) else None
