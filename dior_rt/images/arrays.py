"""Photos and strokes in memory: convert arrays and Pillow images to the arrays that the kernels take, and
back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.photo import image_of, photo_of
from dior_rt.images.primaries import Matrix, conversion, convert, srgb
from dior_rt.kernels import NumpyOps, Stroke, Strokes

Picture = Image.Image | NDArray

#: The largest value of a float photo, as a multiple of white. float32 cannot represent the step from brighter
#: values down to what a display shows.
BRIGHTEST = 16

SHAPE_TOLERANCE = (
    0.01  # of a side; resizing by any whole number of pixels stays within it, or within one pixel
)


def read_pixels(photo: Picture) -> NDArray:
    """Return the photo's (H, W, 3) pixels, upright and on the sRGB curve, without alpha. Raises InputError.

    A Pillow image is read as its file would be: by its EXIF orientation and its colour profile.
    """
    if isinstance(photo, Image.Image):
        _check_8_bit(photo)
        return photo_of(photo).pixels
    pixels = np.asarray(photo)
    _check_array("a photo", pixels, channels=3)
    if pixels.dtype == np.float32 and not (pixels.min() >= 0 and pixels.max() <= BRIGHTEST):
        raise InputError(f"A float photo must be finite and >= 0, and at most {BRIGHTEST} times white.")
    return pixels


def to_8_bits(pixels: NDArray) -> NDArray[np.uint8]:
    """Return a photo's pixels for viewing: uint8, clipped at display white."""
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)
    return (np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8)


def like_photo(pixels: NDArray, photo: Picture) -> Picture:
    """Return the pixels as the photo's kind: a Pillow image gets the photo's alpha, and its ICC and EXIF
    data.
    """
    return image_of(photo_of(photo), pixels) if isinstance(photo, Image.Image) else pixels


def primaries_of(photo: Picture) -> Matrix:
    """Return the primaries that a Pillow image's profile names, or those of sRGB for an array."""
    return photo_of(photo).primaries if isinstance(photo, Image.Image) else srgb()


def in_primaries_of(photo: Picture, strokes: Any) -> Any:
    """Return strokes of any kind with their light in a photo's primaries, which a Pillow image may name."""
    return to_primaries(strokes, primaries_of(photo))


def to_primaries(strokes: Any, target: Matrix) -> Any:
    """Return strokes of any kind with their light in the target's primaries.

    Arrays, Strokes and Stroke use the primaries of sRGB. A Pillow image of strokes uses those of its profile.
    """
    if isinstance(strokes, Image.Image):
        _check_8_bit(strokes)
        return convert_raster(_read_rgba(strokes), conversion(photo_of(strokes).primaries, target))
    matrix = conversion(srgb(), target)
    if matrix is None:
        return strokes
    if isinstance(strokes, Strokes):
        light = np.where(strokes.mask[..., None] > 0, strokes.light, 0)
        return Strokes(convert(light.astype(np.float32), matrix), strokes.mask)
    if isinstance(strokes, Sequence):
        return convert_strokes(strokes, matrix)
    return convert_raster(_read_rgba(strokes), matrix)


def convert_strokes(strokes: Sequence[Stroke], matrix: Matrix | None) -> list[Stroke]:
    """Return the strokes with their light converted by a matrix of `primaries.conversion`."""
    if matrix is None:
        return list(strokes)
    converted = []
    for stroke in strokes:
        red, green, blue = convert(np.array(stroke.color, np.float64), matrix).tolist()
        converted.append(replace(stroke, color=(red, green, blue)))
    return converted


def convert_raster(raster: NDArray, matrix: Matrix | None) -> NDArray:
    """Return the (H, W, 4) light and mask with the light converted. The result is float32 and linear."""
    if matrix is None:
        return raster
    light, mask = raster[..., :3], raster[..., 3]
    if light.dtype != np.float32:
        mask = mask / np.float32(np.iinfo(mask.dtype).max)
        light = NumpyOps().decode_srgb(light)
    return np.dstack([convert(np.where(mask[..., None] > 0, light, 0), matrix), mask]).astype(np.float32)


def read_strokes(strokes: Strokes | Picture) -> tuple[NDArray, NDArray]:
    """Return the strokes' light (H, W, 3) and mask (H, W). Raises InputError.

    In an RGBA picture, alpha is the mask. Integers are sRGB-encoded, and floats are linear.
    """
    if isinstance(strokes, Strokes):
        light, mask = np.asarray(strokes.light, np.float32), np.asarray(strokes.mask, np.float32)
    else:
        rgba = _read_rgba(strokes)
        light, mask = rgba[..., :3], rgba[..., 3]
    if light.shape != (*mask.shape, 3) or mask.ndim != 2 or mask.size == 0:
        raise InputError(f"Strokes need light (rows, columns, 3) and a mask of its size, not {light.shape}.")
    if mask.dtype == np.float32 and not (mask.min() >= 0 and mask.max() <= 1):
        raise InputError("The strokes' mask must lie in 0..1.")
    if light.dtype == np.float32:
        drawn = light[mask > 0]
        if not (np.isfinite(drawn).all() and (drawn >= 0).all()):
            raise InputError("The strokes' light must be finite and >= 0.")
    return light, mask


def check_same_shape(strokes: tuple[int, ...], photo: tuple[int, ...]) -> None:
    """Raise InputError unless two (rows, columns) have the same aspect ratio, whatever their size."""
    (h, w), (rows, columns) = strokes, photo
    apart = [(w, h * columns / rows), (h, w * rows / columns)]
    if not any(abs(side - wanted) <= max(1, SHAPE_TOLERANCE * wanted) for side, wanted in apart):
        raise InputError(
            f"The strokes are {w} x {h} pixels and the photo is {columns} x {rows}: the shapes differ."
        )


def _read_rgba(picture: Picture) -> NDArray:
    if not isinstance(picture, Image.Image):
        pixels = np.asarray(picture)
        _check_array("strokes", pixels, channels=4)
        return pixels
    _check_8_bit(picture)
    if not picture.has_transparency_data:
        raise InputError("The strokes have no alpha channel to say where light was drawn.")
    photo = photo_of(picture)
    assert photo.alpha is not None  # it has transparency
    alpha = photo.alpha.astype(photo.pixels.dtype)
    if alpha.dtype != photo.alpha.dtype:
        alpha *= alpha.dtype.type(257)
    return np.dstack([photo.pixels, alpha])


def _check_8_bit(picture: Image.Image) -> None:
    if picture.mode.startswith(("I", "F")):
        raise InputError(f"A Pillow image of mode {picture.mode} has no 8-bit colour; pass an array instead.")
    if 0 in picture.size:
        raise InputError("The image has no pixels.")


def _check_array(what: str, pixels: NDArray, channels: int) -> None:
    fits = pixels.ndim == 3 and pixels.shape[2] == channels and pixels.size > 0
    if not fits or pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(
            f"As an array {what} must be (rows, columns, {channels}) of uint8, uint16 or float32, "
            f"not {pixels.shape} of {pixels.dtype}."
        )
