"""OpenEXR files of linear light, by the format's own library."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.pictures import MOST_PIXELS


def read_exr(path: Path, what: str) -> NDArray[np.float32]:
    """The channels R, G, B and, where there is one, A as (H, W, 3 or 4) float32, unchanged.

    The picture is the display window; what the data window leaves open is 0. what: how an error calls the
    file. Raises InputError for a file that is damaged, of more than MOST_PIXELS, or without those channels.
    """
    import Imath
    import OpenEXR

    check_readable(path, what)
    try:
        with _hushed():
            file = OpenEXR.InputFile(str(path))
            header = file.header()
            names = [name for name in "RGBA" if name in header["channels"]]
            (x, y, width, height), (left, top, columns, rows) = (
                _box(header[window]) for window in ("displayWindow", "dataWindow")
            )
            if names[:3] != ["R", "G", "B"]:
                raise ValueError("it has no channels R, G and B")
            if max(width * height, columns * rows) > MOST_PIXELS:
                raise ValueError(f"it has more than {MOST_PIXELS // 10**6} megapixels")
            planes = file.channels(names, Imath.PixelType(Imath.PixelType.FLOAT))
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise InputError(f"Cannot read the {what} {path}: {reason(error)}.") from error
    data = np.stack([np.frombuffer(plane, np.float32).reshape(rows, columns) for plane in planes], axis=-1)
    if (left, top, columns, rows) == (x, y, width, height):
        return data
    picture = np.zeros((height, width, len(names)), np.float32)
    first_row, first_column = max(y, top), max(x, left)
    last_row, last_column = min(y + height, top + rows), min(x + width, left + columns)
    if last_row > first_row and last_column > first_column:
        shown = data[first_row - top : last_row - top, first_column - left : last_column - left]
        picture[first_row - y : last_row - y, first_column - x : last_column - x] = shown
    return picture


def write_exr(path: Path, light: NDArray[np.float32]) -> None:
    """Write (H, W, 3) linear light as float32 channels R, G and B, whole or not at all. Raises InputError."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as file, _hushed():
        try:
            OpenEXR.File(header, {"RGB": np.ascontiguousarray(light)}).write(file.name)
        except RuntimeError as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error


def _box(window: object) -> tuple[int, int, int, int]:
    """(left, top, width, height) of a window, whose corners are both inside."""
    low, high = window.min, window.max  # type: ignore[attr-defined]
    return low.x, low.y, high.x - low.x + 1, high.y - low.y + 1


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    """Keep the library's own words off standard error: it prints what it also raises."""
    try:
        saved = os.dup(2)
    except OSError:  # there is no standard error to speak on
        yield
        return
    try:
        with open(os.devnull, "wb") as nothing:  # noqa: PTH123 - a device, not a path
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
