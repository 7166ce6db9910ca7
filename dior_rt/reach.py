"""How far light carries from the strokes: the model's light within their reach, the photo's beyond it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.flow.sampler import Array
from dior_rt.light import apply_log_ratio, log_ratio

LEAST: Final = 1e-3  # of the picture's longer side: finer than any light grid


def check_reach(reach: float | None) -> None:
    """Raise InputError for a reach that is not a number of at least LEAST."""
    if reach is not None and not (math.isfinite(reach) and reach >= LEAST):
        raise InputError(f"reach must be a number of at least {LEAST:g}, not {reach}.")


def within_reach(source: Array, relit: Array, mask: Array, reach: float) -> Array:
    """Return `relit` where the mask (h, w) is above 0, fading to `source` beyond the reach."""
    return fade(source, relit, closeness(mask > 0, reach))


def fade(source: Array, relit: Array, nearness: Array) -> Array:
    """Return the relit light with its log-ratio to the source scaled by `nearness`.

    source, relit: (h, w, 3) linear light; nearness: (h, w), 1 is all of `relit` and 0 all of `source`.
    """
    return apply_log_ratio(source, log_ratio(relit, source) * nearness[..., None])


def closeness(drawn: NDArray[np.bool_], reach: float) -> Array:
    """Return exp(-(d / reach)^2), (h, w), where d is a cell's distance to the nearest drawn cell.

    d is in longer sides of the picture. The value is 1 where drawn, 0.37 at the reach, and 0 where nothing is
    drawn at all. The nearest drawn cell gives the greatest value, and the greatest product is found along the
    rows, then down the columns.
    """
    down, along = (_fall(size, reach * max(drawn.shape)) for size in drawn.shape)
    nearest = np.stack([(along * row).max(axis=1) for row in drawn])
    return np.stack([(down * column).max(axis=1) for column in nearest.T], axis=1)


def _fall(size: int, reach: float) -> Array:
    """Return (size, size): exp(-(d / reach)^2) between all cells of a line."""
    place = np.arange(size)
    return np.exp(-(((place[:, None] - place) / reach) ** 2)).astype(np.float32)
