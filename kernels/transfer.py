"""Quotient light: the light of a small grid on the full-size photo, without leaking across edges.

    photo' = (photo + e) * R - e = photo + (photo + e) * (R - 1),     e = 0.02, linear light

On the grid R = (relit + e) / (source + e). At a pixel, sqrt(R) is the weighted mean of the 3 x 3 cells around
the one it lies in (joint bilateral upsampling; Kopf, Cohen, Lischinski, Uyttendaele, 2007):

    w_k = B(dx) * B(dy) / (1 + (g - g_k)^2 / SIGMA^2)

B is the quadratic B-spline, which is smooth across cells; g is the pixel's lightness and g_k the cell's. The
reciprocal is taken within 12 % by exponent arithmetic, the same on every device: a weight only needs its
shape. The root lies between R, whose mean is drawn to the brightest cell, and log R, which is a little more
accurate still and needs an exponential for every sample.

A cell's value is a mean, so a smooth interpolation of the values would be flatter than the light was. Before
it, sqrt(R) is sharpened by what the spline will blur, and kept between the least and greatest of its 3 x 3
neighbours: no halo can come of it, and R never leaves the range of the grid's own quotients."""

from __future__ import annotations

import numpy as np

from dior_rt.kernels.color import linear_to_srgb
from dior_rt.kernels.types import FloatArray

EPSILON = 0.02
SIGMA = 0.03
#: The lightness g of a pixel: this mean of its sRGB-encoded channels, clipped to 0..1.
LIGHTNESS = np.array([0.25, 0.5, 0.25], np.float32)


def nodes(source: FloatArray, relit: FloatArray) -> FloatArray:
    """(h, w, 3) linear grids -> (h + 2, w + 2, 4) float32: sqrt(R) - 1, g / SIGMA by cell, the border
    repeated. Where the grids are equal the first is exactly 0.

    R is kept below 2^126, so that it is a normal float32.
    """
    quotient = (relit.astype(np.float64) + EPSILON) / (source.astype(np.float64) + EPSILON)
    q = _sharpen(np.sqrt(np.minimum(quotient, 2.0**126)) - 1)
    lightness = np.clip(linear_to_srgb(source) @ LIGHTNESS, 0, 1) / SIGMA
    cells = np.concatenate([q, lightness[..., None]], 2)
    return np.pad(cells, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.float32)


def rough_reciprocal(q: FloatArray) -> FloatArray:
    """1 / q within 12 % for 1 <= q < 2**60, continuous and falling: its bits as an integer, negated."""
    return (np.int32(0x7EF311C7) - q.view(np.int32)).view(np.float32)


def _sharpen(x: np.ndarray) -> np.ndarray:
    """x + (x - the spline's mean over each cell), within the range of the 3 x 3 neighbours; (h, w, 3)."""
    blurred, low, high = x, x, x
    for axis in (0, 1):
        before, here, after = _neighbours(blurred, axis)
        blurred = (before + 4 * here + after) / 6
        low = np.minimum.reduce(_neighbours(low, axis))
        high = np.maximum.reduce(_neighbours(high, axis))
    return np.clip(2 * x - blurred, low, high)


def _neighbours(x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every cell the one before, itself, the one after along axis 0 or 1; the border is repeated."""
    along = x.swapaxes(0, axis)
    before, after = np.concatenate([along[:1], along[:-1]]), np.concatenate([along[1:], along[-1:]])
    return before.swapaxes(0, axis), x, after.swapaxes(0, axis)
