"""OpenEXR pictures as photos: scene-linear light in floating point, in which highlights exceed white.

Reading puts the pixels on sRGB's curve, continued above 1. Writing an EXR takes them back to linear light. In
other formats light ends at display white.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.images.arrays import BRIGHTEST
from dior_rt.images.exr import read_exr_picture
from dior_rt.images.photo import Photo
from dior_rt.images.primaries import conversion, convert, srgb
from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear

#: The largest linear value that a float photo holds, as a multiple of white.
MOST_LIGHT: Final = float(srgb_to_linear(np.float64(BRIGHTEST)))


def read(path: Path) -> Photo:
    """Read the first part, with its colours in sRGB's primaries. Raises InputError."""
    picture = read_exr_picture(path, "photo")
    light, notices = picture.pixels[..., :3], []
    broken = np.asarray(~np.isfinite(light).all(axis=-1))
    if broken.any():
        notices.append(f"{int(broken.sum())} of its pixels are not finite; they are read as black.")
        light = np.where(broken[..., None], np.float32(0), light)
    alpha = None
    if picture.pixels.shape[2] == 4:
        alpha = np.clip(np.nan_to_num(picture.pixels[..., 3]), 0, 1).astype(np.float32)
        light = np.divide(light, alpha[..., None], out=np.zeros_like(light), where=(alpha > 0)[..., None])
    if (matrix := conversion(picture.primaries, srgb())) is not None:
        light = convert(light, matrix).astype(np.float32)
        notices.append("Its colours are converted to sRGB's primaries.")
    outside = ((light < 0) | (light > MOST_LIGHT)).any(axis=-1)
    if outside.any():
        notices.append(
            f"{int(outside.sum())} of its pixels are below 0 or above {MOST_LIGHT:.0f} times white; "
            "they are taken to those bounds."
        )
        light = np.clip(light, 0, MOST_LIGHT)
    return Photo(encode(light), alpha, notices=tuple(notices))


def encode(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return linear light >= 0 encoded by sRGB's curve, continued above 1."""
    return np.minimum(linear_to_srgb(light), BRIGHTEST).astype(np.float32)


def to_light(photo: Photo) -> NDArray[np.float32]:
    """Return the photo as an EXR stores it: (H, W, 3 or 4) linear light, multiplied by its alpha."""
    pixels, alpha = photo.pixels, photo.alpha
    if pixels.dtype != np.float32:
        pixels = pixels / np.iinfo(pixels.dtype).max
    light = srgb_to_linear(pixels.astype(np.float64))
    if alpha is None:
        return light.astype(np.float32)
    if alpha.dtype != np.float32:
        alpha = alpha / np.iinfo(alpha.dtype).max
    return np.dstack([light * alpha[..., None], alpha]).astype(np.float32)
