"""Transfer the light of a small grid to the full-size photo as a quotient, without leaking across edges.

    photo' = (photo + e) * R - e = photo + (photo + e) * (R - 1),     e = 0.02, linear light

On the grid R = (relit + e) / (source + e). At a pixel, sqrt(R) is the weighted mean of the 3 x 3 cells around
the one it lies in (joint bilateral upsampling; Kopf, Cohen, Lischinski, Uyttendaele, 2007):

    w_k = B(dx) * B(dy) / (1 + (g - g_k)^2 / SIGMA^2)

B is the quadratic B-spline, which is smooth across cells; g is the pixel's lightness and g_k the cell's. The
reciprocal is computed to within 12 % by exponent arithmetic, the same on every device; only the shape of
the weight matters. The square root is a compromise between R, whose mean favours the brightest cell, and
log R, which is a little more accurate but needs an exponential per sample.

A cell holds a mean, so a smooth interpolation of cells is flatter than the light was. Therefore sqrt(R) is
first sharpened to compensate the blur of the spline, and clipped to the range of its 3 x 3 neighbours. So
no halo can appear, and R stays within the range of the grid's quotients.
"""

from __future__ import annotations

import numpy as np

from dior_rt.kernels.color import linear_to_srgb
from dior_rt.kernels.types import FloatArray

EPSILON = 0.02
SIGMA = 0.03
#: The weights of the sRGB-encoded channels in the lightness g of a pixel, which is clipped to 0..1.
LIGHTNESS = np.array([0.25, 0.5, 0.25], np.float32)


def nodes(source: FloatArray, relit: FloatArray) -> FloatArray:
    """Return sqrt(R) - 1 and g / SIGMA of each cell, with the border repeated, (h + 2, w + 2, 4) float32.

    source, relit: (h, w, 3), linear. Where they are equal, the first is exactly 0. R is limited to 2^126,
    so that it is a normal float32.
    """
    quotient = (relit.astype(np.float64) + EPSILON) / (source.astype(np.float64) + EPSILON)
    q = _sharpen(np.sqrt(np.minimum(quotient, 2.0**126)) - 1)
    lightness = np.clip(linear_to_srgb(source) @ LIGHTNESS, 0, 1) / SIGMA
    cells = np.concatenate([q, lightness[..., None]], 2)
    return np.pad(cells, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.float32)


def rough_reciprocal(q: FloatArray) -> FloatArray:
    """Return 1 / q within 12 % for 1 <= q < 2**60, continuous and falling, by negating its bits."""
    return (np.int32(0x7EF311C7) - q.view(np.int32)).view(np.float32)


def _sharpen(x: np.ndarray) -> np.ndarray:
    """Return x + (x - the spline's mean over each cell), within the range of the 3 x 3 neighbours; (h, w,
    3)."""
    blurred, low, high = x, x, x
    for axis in (0, 1):
        before, here, after = _neighbours(blurred, axis)
        blurred = (before + 4 * here + after) / 6
        low = np.minimum.reduce(_neighbours(low, axis))
        high = np.maximum.reduce(_neighbours(high, axis))
    return np.clip(2 * x - blurred, low, high)


def _neighbours(x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cells before, at and after every cell along axis 0 or 1; the border is repeated."""
    along = x.swapaxes(0, axis)
    before, after = np.concatenate([along[:1], along[:-1]]), np.concatenate([along[1:], along[-1:]])
    return before.swapaxes(0, axis), x, after.swapaxes(0, axis)
