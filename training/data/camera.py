"""A camera between a rendered scene and the photo, which makes renders resemble real pictures.

    linear light -> optics (blur) -> sensor (noise) -> picture style (develop) -> sharpening -> JPEG -> 8 bits

The picture style is the camera's own and shapes photo and relit picture alike; all the rest befalls the photo
alone. Everything happens at the size of the light grid, so each stage is what is left of it once a photo's
pixels are averaged into cells. A third of the cameras do nothing but encode, as sRGB has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageChops

from dior_rt.kernels.color import linear_to_srgb

Raster = NDArray[np.float32]

PLAIN_SHARE = 1 / 3  # share of cameras, and of white balances, that change nothing
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # ITU-R BT.709
SHARPENING_BLUR = 0.7  # cells; with a wider blur, three taps would invert the finest detail
ZERO = 128  # the code of a zero error


@dataclass(frozen=True)
class Camera:
    """One camera; as it stands, one that does nothing but encode to sRGB.

    The picture style works on encoded values v in 0..1, in this order:

    gamma: v ** gamma.
    contrast: v + contrast * (3 v^2 - 2 v^3 - v), an S-curve; rising for -2 < contrast < 1.
    lift: what black becomes; lift + (1 - lift) v.
    saturation: v + (saturation - 1) * (v - luma), clipped to 0..1.

    shot_noise, read_noise: a cell of linear light x has noise of variance shot_noise * x + read_noise ** 2.
    blur: the standard deviation of the lens' blur in cells, at most 0.7.
    sharpening: the share of what a blur of 0.7 cells takes away that is added once more.
    quality: of the JPEG, 1..95 as libjpeg counts; None where the photo never was one.
    pixels: the side of a cell in the photo's pixels, as far as its JPEG is concerned.
    """

    gamma: float = 1.0
    contrast: float = 0.0
    lift: float = 0.0
    saturation: float = 1.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    blur: float = 0.0
    sharpening: float = 0.0
    quality: int | None = None
    pixels: float = 3.0

    def develop(self, linear: Raster) -> Raster:
        """Return the picture of linear light (H, W, 3): float32, sRGB-encoded, in 0..1, not rounded.

        Each channel rises with its light, and greys stay grey. Light outside 0..1 is clipped.
        """
        v = linear_to_srgb(np.clip(linear, 0, 1)).astype(np.float32) ** np.float32(self.gamma)
        v += np.float32(self.contrast) * (v * v * (3 - 2 * v) - v)
        v = np.float32(self.lift) + np.float32(1 - self.lift) * v
        v += np.float32(self.saturation - 1) * (v - (v @ LUMA)[..., None])
        return np.clip(v, 0, 1)

    def shot(self, linear: Raster, rng: Generator) -> Raster:
        """Return a photo of linear light (H, W, 3): float32, sRGB-encoded, multiples of 1/255 in 0..1."""
        seen = softened(np.asarray(linear, np.float32), self.blur)
        deviation = np.sqrt(np.float32(self.shot_noise) * seen.clip(0, 1) + np.float32(self.read_noise**2))
        photo = self.develop(seen + deviation * rng.standard_normal(seen.shape, np.float32))
        photo += np.float32(self.sharpening) * (photo - softened(photo, SHARPENING_BLUR))
        if self.quality is not None:
            photo += jpeg_error(photo, self.quality, self.pixels)
        return eight_bits(photo).astype(np.float32) / np.float32(255)


def random_camera(rng: Generator) -> Camera:
    """Return a camera of a common kind: mild in style, and in a third of the cases plain sRGB without
    flaws.
    """
    if rng.uniform() < PLAIN_SHARE:
        return Camera()
    # A pixel's noise follows Brooks et al., who fitted it to real sensors (Unprocessing Images for Learned
    # Raw Denoising, CVPR 2019). Demosaicing and denoising make it similar over about 2 x 2 pixels, so that a
    # cell, 4 to 16 pixels wide, averages 4 to 64 independent draws.
    shot = 10 ** rng.uniform(-4, math.log10(0.012))
    read = 10 ** ((2.18 * math.log10(shot) + 1.2 + rng.normal(0, 0.26)) / 2)
    draws = 4 ** rng.uniform(1, 3)
    return Camera(
        gamma=math.exp(rng.normal(0, 0.07)),
        contrast=rng.uniform(-0.15, 0.4),
        lift=rng.uniform(0, 0.03) * (rng.uniform() < 0.3),
        saturation=rng.uniform(0.85, 1.2),
        shot_noise=shot / draws,
        read_noise=read / draws**0.5,
        blur=rng.uniform(0, 0.5),
        sharpening=rng.uniform(0, 0.5),
        quality=int(rng.integers(40, 96)) if rng.uniform() < 0.5 else None,
        pixels=rng.uniform(2.5, 3.5),
    )


def white_balance(rng: Generator) -> Raster:
    """Return (3,) gains for all linear rasters of a pair: the remaining error of a camera's white balance.

    It is mostly warm or cool, slightly green or magenta. White keeps its luminance. A third have no error.
    """
    if rng.uniform() < PLAIN_SHARE:
        return np.ones(3, np.float32)
    warmth, green = rng.normal(0, 0.12), rng.normal(0, 0.03)
    gains = np.exp([warmth, green, -1.4 * warmth]).astype(np.float32)
    return gains / (gains @ LUMA)


def softened(raster: Raster, deviation: float) -> Raster:
    """Return (H, W, C) blurred in both directions by three taps of that standard deviation in cells.

    Edges are extended.
    """
    side = np.float32(deviation**2 / 2)
    for axis in (0, 1):
        lines = np.moveaxis(raster, axis, 0)
        neighbours = np.concatenate([lines[:1], lines[:-1]]) + np.concatenate([lines[1:], lines[-1:]])
        raster = np.moveaxis((1 - 2 * side) * lines + side * neighbours, 0, axis)
    return raster


def jpeg_error(photo: Raster, quality: int, pixels: float) -> Raster:
    """Return (H, W, 3), the error that JPEG (libjpeg's, chroma halved) adds to the cells' means of a photo in
    0..1.

    The photo is drawn at `pixels` per cell, so that a block of 8 pixels spans 8 / pixels cells, and chroma's
    block twice that. Drawing and averaging blur by themselves, so only the error is averaged.
    """
    height, width = photo.shape[:2]
    size = round(width * pixels), round(height * pixels)
    whole = Image.fromarray(eight_bits(photo)).resize(size, Image.Resampling.BILINEAR)
    file = BytesIO()
    whole.save(file, "JPEG", quality=quality, subsampling="4:2:0")
    error = ImageChops.subtract(Image.open(file), whole, offset=ZERO)
    cells = np.asarray(error.resize((width, height), Image.Resampling.BOX), np.float32)
    return (cells - np.float32(ZERO)) / np.float32(255)


def eight_bits(encoded: Raster) -> NDArray[np.uint8]:
    """Return values encoded in 0..1, rounded to codes. Values outside are clipped."""
    return np.rint(encoded * 255).clip(0, 255).astype(np.uint8)
