"""Read and write JPEG XL of 8 and 16 bits with the profile, by OpenImageIO (extra [jxl])."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from dior_rt.images.icc import interpret
from dior_rt.images.photo import MOST_PIXELS, Photo

ICC = "ICCProfile"


def read(path: Path) -> Photo:
    """Read the first frame. Raises ValueError for a damaged file."""
    file = OpenImageIO.ImageInput.open(str(path))
    if file is None:
        raise ValueError(_problem())
    try:
        spec = file.spec()
        if not 0 < spec.width * spec.height <= MOST_PIXELS:
            raise ValueError(f"it is empty, or has more than {MOST_PIXELS // 10**6} megapixels")
        if spec.format.basetype in (OpenImageIO.HALF, OpenImageIO.FLOAT):
            raise ValueError("it has floating-point samples; save it as EXR, or as a 16-bit PNG")
        depth, dtype = (
            ("uint8", np.uint8) if spec.format.basetype == OpenImageIO.UINT8 else ("uint16", np.uint16)
        )
        samples = file.read_image(0, 0, 0, spec.nchannels, depth)
        if samples is None:
            raise ValueError(_problem())
        icc = spec.getattribute(ICC)
    finally:
        file.close()
    samples = np.asarray(samples, dtype).reshape(spec.height, spec.width, spec.nchannels)
    alpha = None
    if spec.nchannels in (2, 4):
        samples, alpha = samples[..., :-1], np.ascontiguousarray(samples[..., -1])
    profile = b"" if icc is None else np.asarray(icc, np.uint8).tobytes()
    coloured = interpret(np.ascontiguousarray(samples), profile)
    return Photo(coloured.pixels, alpha, coloured.curves, coloured.icc, notices=coloured.notices, lossy=True)


def write(path: Path, samples: NDArray, icc: bytes, quality: int | None) -> None:
    """Write (H, W, 3 or 4) uint8 or uint16 samples. Quality 100 or None keeps them exactly.

    Raises ValueError where writing fails.
    """
    height, width, channels = samples.shape
    spec = OpenImageIO.ImageSpec(width, height, channels, samples.dtype.name)
    spec.attribute("Compression", f"jpegxl:{100 if quality is None else quality}")
    if icc:
        spec.attribute(ICC, OpenImageIO.TypeDesc(f"uint8[{len(icc)}]"), np.frombuffer(icc, np.uint8))
    if channels == 4:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    file = OpenImageIO.ImageOutput.create(str(path))
    if file is None or not file.open(str(path), spec):
        raise ValueError(_problem())
    try:
        if not file.write_image(np.ascontiguousarray(samples)):
            raise ValueError(file.geterror())
    finally:
        if not file.close():
            raise ValueError(file.geterror())


def _problem() -> str:
    return str(OpenImageIO.geterror()).strip().partition("\n")[0] or "it is damaged"
