"""Quotient light: carrying the light of a small grid over to the full-size photo without leaking across
edges.

    photo' = (photo + e) * R - e = photo + (photo + e) * (R - 1),     e = 0.02, linear light

On the grid, log R = log((relit + e) / (source + e)). Between the grid's cells it is not interpolated
blindly: in every 3 x 3 window it is fitted by a line in the photo's lightness g (the guided filter of He,
Sun, Tang, 2010),

    log R ~ a * g + b,     a = cov(g, log R) / (var(g) + LAMBDA),  b = mean(log R) - a * mean(g)

and a, b, averaged over the windows that hold a cell and interpolated bilinearly, are applied to the
lightness of each full-size pixel. log R stays between the smallest and the largest value of the grid, by
channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dior_rt.kernels.color import linear_to_srgb
from dior_rt.kernels.types import FloatArray

EPSILON = 0.02
LAMBDA = 0.01
#: The lightness g of a pixel: the weighted mean of its sRGB-encoded channels.
LIGHTNESS = np.array([0.25, 0.5, 0.25], np.float32)


@dataclass(frozen=True)
class Light:
    """log R = slope * g + offset by cell, (h, w, 3) each, clipped to low..high, (3,) each; all float32."""

    slope: FloatArray
    offset: FloatArray
    low: FloatArray
    high: FloatArray


def fit(source: FloatArray, relit: FloatArray) -> Light:
    """The light that turns the grid `source` into `relit`; both (h, w, 3) linear >= 0."""
    guide = (linear_to_srgb(source) @ LIGHTNESS.astype(np.float64))[..., None]
    log_r = np.log((relit.astype(np.float64) + EPSILON) / (source.astype(np.float64) + EPSILON))
    mean_g, mean_r = _window_mean(guide), _window_mean(log_r)
    variance = _window_mean(guide * guide) - mean_g * mean_g
    slope = (_window_mean(guide * log_r) - mean_g * mean_r) / (np.maximum(variance, 0) + LAMBDA)
    offset = mean_r - slope * mean_g
    return Light(
        _window_mean(slope).astype(np.float32),
        _window_mean(offset).astype(np.float32),
        log_r.min((0, 1)).astype(np.float32),
        log_r.max((0, 1)).astype(np.float32),
    )


def _window_mean(x: np.ndarray) -> np.ndarray:
    """Mean over the 3 x 3 neighbours that exist; (h, w, c) -> (h, w, c)."""
    for axis in (0, 1):
        padded = np.pad(x, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        n = x.shape[axis]
        first, middle, last = (np.take(padded, range(k, k + n), axis) for k in range(3))
        neighbours = np.full(n, 3.0)
        neighbours[0] -= 1
        neighbours[-1] -= 1
        x = (first + middle + last) / neighbours.reshape([-1 if i == axis else 1 for i in range(3)])
    return x
