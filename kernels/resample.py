"""Exact area resampling: how much of each input pixel an output cell covers, along one axis."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dior_rt.kernels.types import FloatArray

#: What a fainter mask counts as: sums of light weighted by it stay normal numbers, on every device.
FAINTEST = 2.0**-60


def bands(height: int, width: int, pixels: int) -> Iterator[slice]:
    """Slices of rows, in order, of about `pixels` pixels each and at least one row: memory stays bounded."""
    rows = max(1, pixels // width)
    for top in range(0, height, rows):
        yield slice(top, min(height, top + rows))


def area_weights(pixels: int, cells: int) -> FloatArray:
    """(cells, pixels) float32: the share of cell i that pixel j fills. Every row sums to 1.

    Cell i spans [i, i + 1) * pixels / cells. The overlaps are computed in units of 1 / cells, as integers, so
    a pixel that a cell does not touch weighs exactly 0.
    """
    cell = np.arange(cells, dtype=np.int64)[:, None] * pixels
    pixel = np.arange(pixels, dtype=np.int64)[None, :] * cells
    overlap = np.minimum(cell + pixels, pixel + cells) - np.maximum(cell, pixel)
    return (np.maximum(overlap, 0) / pixels).astype(np.float32)


def spline_taps(pixels: int, cells: int) -> tuple[np.ndarray, FloatArray]:
    """The cell that each pixel's centre lies in, and the quadratic B-spline's weights of the cells around it.

    (pixels,) integers, and (3, pixels) float32 for the cell before, the cell itself, the one after.
    """
    centre = (2 * np.arange(pixels, dtype=np.int64) + 1) * cells
    cell = centre // (2 * pixels)
    d = ((centre - (2 * cell + 1) * pixels) / (2 * pixels)).astype(np.float32)
    return cell, np.stack([0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2])
