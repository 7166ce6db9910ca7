"""Read and write OpenEXR files of linear light with the OpenEXR library."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.images.photo import MOST_PIXELS
from dior_rt.images.primaries import Matrix, srgb, to_xyz


@dataclass(frozen=True)
class ExrPicture:
    """A picture from an EXR file.

    pixels: (H, W, 3 or 4) float32. primaries: those of its RGB, as `primaries.to_xyz`.
    """

    pixels: NDArray[np.float32]
    primaries: Matrix


def read_exr(path: Path, what: str) -> NDArray[np.float32]:
    """Return R, G, B and, where present, A of the first part as (H, W, 3 or 4) float32, unchanged.

    The picture is the display window. Pixels outside the data window are 0. what: the name of the file in
    errors. Raises InputError for a file that is damaged, deep, larger than MOST_PIXELS, or without those
    channels.
    """
    return read_exr_picture(path, what).pixels


def read_exr_picture(path: Path, what: str) -> ExrPicture:
    """Return the picture of `read_exr` with the primaries that the header names, or Rec. 709's by default."""
    import OpenEXR

    check_readable(path, what)
    try:
        with _hushed():
            # Check the header first, because a few bytes can promise a picture of any size.
            header = OpenEXR.File(str(path), header_only=True).header()
            if header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
                raise ValueError("it is a deep EXR, with many samples a pixel; flatten it first")
            shown, stored = _box(header["displayWindow"]), _box(header["dataWindow"])
            if not all(0 < width * height <= MOST_PIXELS for _, _, width, height in (shown, stored)):
                raise ValueError(f"it is empty, or has more than {MOST_PIXELS // 10**6} megapixels")
            channels = OpenEXR.File(str(path), separate_channels=True).channels()
            if not all(name in channels for name in "RGB"):
                raise ValueError("it has no channels R, G and B")
            planes = [channels[name].pixels for name in "RGBA" if name in channels]
        data = np.stack(planes, axis=-1).astype(np.float32, copy=False)
        pixels = data if shown == stored else _frame(data, shown, stored)
        return ExrPicture(pixels, _primaries(header))
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise InputError(f"Cannot read the {what} {path}: {reason(error)}.") from error


def _primaries(header: dict[str, Any]) -> Matrix:
    given = header.get("chromaticities")
    if given is None:
        return srgb()
    rx, ry, gx, gy, bx, by, wx, wy = (float(value) for value in given)
    return to_xyz((rx, ry, gx, gy, bx, by, wx, wy))


def write_exr(path: Path, light: NDArray[Any], texts: Mapping[str, str] | None = None) -> None:
    """Write (H, W, 3 or 4) linear light, float32 or float16, as R, G, B and A, whole or not at all.

    The colours of a picture with A are multiplied by A, as EXR requires. texts: attributes of the header.
    Raises InputError.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(texts or {})}
    name = "RGB" if light.shape[2] == 3 else "RGBA"
    with replacing(path) as file, _hushed():
        try:
            OpenEXR.File(header, {name: np.ascontiguousarray(light)}).write(file.name)
        except RuntimeError as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error


Box = tuple[int, int, int, int]  # left, top, width, height


def _box(window: Any) -> Box:
    (left, top), (right, bottom) = (tuple(int(v) for v in corner) for corner in window)
    return left, top, right - left + 1, bottom - top + 1


def _frame(data: NDArray[np.float32], shown: Box, stored: Box) -> NDArray[np.float32]:
    """Return the part of the stored box that is shown, in a picture of the shown box's size."""
    picture = np.zeros((shown[3], shown[2], data.shape[2]), np.float32)
    left, top = max(shown[0], stored[0]), max(shown[1], stored[1])
    right, bottom = (
        min(shown[0] + shown[2], stored[0] + stored[2]),
        min(shown[1] + shown[3], stored[1] + stored[3]),
    )
    if left < right and top < bottom:
        part = data[top - stored[1] : bottom - stored[1], left - stored[0] : right - stored[0]]
        picture[top - shown[1] : bottom - shown[1], left - shown[0] : right - shown[0]] = part
    return picture


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Suppress what the library prints when it raises: C code to stderr, Python code to stdout."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        with contextlib.suppress(OSError):  # a closed stream prints nothing
            saved = os.dup(2)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, 2)
            nothing = os.open(os.devnull, os.O_WRONLY)
            stack.callback(os.close, nothing)
            os.dup2(nothing, 2)
        yield
