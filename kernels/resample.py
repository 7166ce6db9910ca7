"""Exact area resampling along one axis: how much of each input pixel an output cell covers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dior_rt.kernels.types import FloatArray

#: Fainter masks count as this, so that sums weighted by them stay normal numbers on every device.
FAINTEST = 2.0**-60


def bands(height: int, width: int, pixels: int) -> Iterator[slice]:
    """Yield slices of at least one row and about `pixels` pixels, in order, so that memory stays bounded."""
    rows = max(1, pixels // width)
    for top in range(0, height, rows):
        yield slice(top, min(height, top + rows))


def area_weights(pixels: int, cells: int) -> FloatArray:
    """Return the share of cell i that pixel j fills, (cells, pixels) float32. Every row sums to 1.

    Cell i spans [i, i + 1) * pixels / cells. The overlaps are computed in units of 1 / cells, as integers, so
    the weight of a pixel that a cell does not touch is exactly 0.
    """
    cell = np.arange(cells, dtype=np.int64)[:, None] * pixels
    pixel = np.arange(pixels, dtype=np.int64)[None, :] * cells
    overlap = np.minimum(cell + pixels, pixel + cells) - np.maximum(cell, pixel)
    return (np.maximum(overlap, 0) / pixels).astype(np.float32)


def spline_taps(pixels: int, cells: int) -> tuple[np.ndarray, FloatArray]:
    """Return the cell of each pixel's centre, and the quadratic B-spline weights of the cells around it.

    Shapes: (pixels,) integers; (3, pixels) float32 for the cell before, the cell itself and the one after.
    """
    centre = (2 * np.arange(pixels, dtype=np.int64) + 1) * cells
    cell = centre // (2 * pixels)
    d = ((centre - (2 * cell + 1) * pixels) / (2 * pixels)).astype(np.float32)
    return cell, np.stack([0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2])
