"""Read HEIC and HEIF of 8, 10 and 12 bits, with profile, EXIF and XMP, by pillow-heif (extra [heic]).

The library turns the picture as its container states, which is the rule for such files. EXIF's orientation is
not applied a second time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif

from dior_rt.images.icc import interpret
from dior_rt.images.metadata import read_exif
from dior_rt.images.photo import MOST_PIXELS, Photo
from dior_rt.images.primaries import profile_of_codes

GAIN_MAP = "It has an HDR gain map, which belongs to the photo's old light; it is left out."


def read(path: Path) -> Photo:
    """Read the primary picture. Raises ValueError, and the library's errors for a damaged file."""
    container = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
    image = container[container.primary_index]
    width, height = image.size
    if not 0 < width * height <= MOST_PIXELS:
        raise ValueError(f"it is empty, or has more than {MOST_PIXELS // 10**6} megapixels")
    info = image.info
    samples = np.asarray(image)
    samples = samples.reshape(height, width, -1)
    alpha = None
    if samples.shape[2] in (2, 4):
        samples, alpha = samples[..., :-1], np.ascontiguousarray(samples[..., -1])
        if image.mode.startswith(("RGBa", "La")):
            samples = _unpremultiplied(samples, alpha)
    coloured = interpret(np.ascontiguousarray(samples), info.get("icc_profile") or _profile(info))
    exif = read_exif(info.get("exif") or b"")
    notices = [GAIN_MAP] if any("hdrgainmap" in str(kind).lower() for kind in info.get("aux", ())) else []
    if len(container) > 1:
        notices.append(f"It holds {len(container)} pictures; the primary one is used.")
    return Photo(
        coloured.pixels,
        alpha,
        coloured.curves,
        coloured.icc,
        exif.kept(),
        notices=(*notices, *coloured.notices),
        xmp=info.get("xmp") or b"",
        lossy=True,
    )


def _profile(info: dict[str, Any]) -> bytes:
    """Return the profile that the container's colour codes stand for. Raises ValueError for HDR."""
    codes = info.get("nclx_profile")
    return profile_of_codes(codes["color_primaries"], codes["transfer_characteristics"]) if codes else b""


def _unpremultiplied(samples: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    top = np.iinfo(samples.dtype).max
    plain = samples.astype(np.uint32) * top // np.maximum(alpha, 1)[..., None]
    return np.minimum(plain, top).astype(samples.dtype)
