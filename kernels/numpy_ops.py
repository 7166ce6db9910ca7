"""Every operation in NumPy: used without OpenCL, and as the reference of the self-tests."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from dior_rt.kernels import draw
from dior_rt.kernels.color import ENCODED_KNEE, LINEAR_KNEE, decode_table, encode_table
from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.resample import FAINTEST, area_weights, bands, spline_taps
from dior_rt.kernels.sparsify import Discs, Lattice, spans
from dior_rt.kernels.transfer import EPSILON, LIGHTNESS, SIGMA, rough_reciprocal
from dior_rt.kernels.types import FloatArray, Picture, Stroke, Strokes

#: Pixels in a band, so that a band stays in the processor's cache.
BAND = 1 << 14
MOST_THREADS = 16


class NumpyOps(Ops):
    """The operations in vectorised NumPy, in bands of rows."""

    name = "numpy"

    def _decode(self, picture: Picture) -> FloatArray:
        if picture.dtype != np.float32:
            return decode_table(picture.dtype)[picture]
        with np.errstate(over="ignore"):
            power = ((np.maximum(picture, np.float32(ENCODED_KNEE)) + 0.055) / 1.055) ** 2.4
        return np.where(picture <= ENCODED_KNEE, picture / np.float32(12.92), power)

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        if dtype == np.float32:
            power = 1.055 * np.maximum(linear, np.float32(LINEAR_KNEE)) ** (1 / 2.4) - 0.055
            return np.where(linear <= LINEAR_KNEE, np.float32(12.92) * linear, power)
        table = encode_table(dtype)
        bits = np.fmin(np.fmax(linear, table.floor), np.float32(1)).view(np.int32)
        return ((table.entry[(bits >> table.shift) - table.first] + bits) >> table.shift).astype(dtype)

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        height, width = picture.shape[:2]
        down, across = area_weights(height, grid[0]), area_weights(width, grid[1])
        total = np.zeros((grid[0], width * 3), np.float32)
        parts = list(bands(height, width, BAND))
        sums: dict[int, tuple[Any, FloatArray]] = {}

        def work(rows: slice) -> None:
            cells = down[:, rows].any(1)
            light = self._decode(picture[rows]).reshape(-1, width * 3)
            sums[rows.start] = cells, down[cells, rows] @ light

        each(work, parts)
        for rows in parts:  # in their order, so that every run adds up to the same bits
            cells, light = sums[rows.start]
            total[cells] += light
        return across @ total.reshape(grid[0], width, 3)

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        height, width = mask.shape
        down, across = area_weights(height, grid[0]), area_weights(width, grid[1])
        total = np.zeros((grid[0], width * 4), np.float32)
        for rows in bands(height, width, BAND):
            cells = down[:, rows].any(1)
            weighted = _weighted(light[rows], mask[rows])
            total[cells] += down[cells, rows] @ weighted.reshape(-1, width * 4)
        mean = across @ total.reshape(grid[0], width, 4)
        weight = mean[..., 3:]
        value = np.divide(mean[..., :3], weight, out=np.zeros((*grid, 3), np.float32), where=weight > 0)
        return Strokes(value, (weight[..., 0] > 0).astype(np.float32))

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        return draw.paint(strokes, size)

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        height, width = lumi.shape[:2]
        row = (np.arange(height) + lattice.oy) // lattice.cell
        column = (np.arange(width) + lattice.ox) // lattice.cell
        pixels = np.float32(np.bincount(row)[:, None, None] * np.bincount(column)[:, None])
        first_rows, first_columns = (np.flatnonzero(np.diff(x, prepend=-1)) for x in (row, column))
        total = np.add.reduceat(np.add.reduceat(lumi, first_rows, 0), first_columns, 1)
        mean = (total / pixels).astype(np.float32, copy=False)
        mask = lattice.keep.astype(np.float32)
        return Strokes((mean * mask[..., None])[row[:, None], column], mask[row[:, None], column])

    def _cut(self, lumi: FloatArray, discs: Discs) -> Strokes:
        height, width = lumi.shape[:2]
        edges = np.zeros((height, width + 1), np.int32)
        row, first, stop = spans(discs, height, width)
        np.add.at(edges, (row, first), 1)
        np.add.at(edges, (row, stop), -1)
        mask = (np.cumsum(edges[:, :width], 1) > 0).astype(np.float32)
        return Strokes(np.where(mask[..., None] > 0, lumi, np.float32(0)), mask)

    def _transfer(self, photo: Picture, nodes: FloatArray) -> Picture:
        height, width = photo.shape[:2]
        result = np.empty(photo.shape, photo.dtype)
        row, down = spline_taps(height, nodes.shape[0] - 2)
        column, across = spline_taps(width, nodes.shape[1] - 2)
        whole = 1 if photo.dtype == np.float32 else np.iinfo(photo.dtype).max
        # (4, rows + 2, W), the nodes before, at and after each pixel's column: one plane per quantity.
        near_columns = [np.ascontiguousarray(np.moveaxis(nodes[:, column + m], 2, 0)) for m in range(3)]

        def work(rows: slice) -> None:
            lightness = np.clip(photo[rows] @ (LIGHTNESS / np.float32(whole)), 0, 1) / np.float32(SIGMA)
            total = np.zeros((4, *lightness.shape), np.float32)
            for k, m in np.ndindex(3, 3):
                near = near_columns[m][:, row[rows] + k]
                distance = lightness - near[3]
                weight = rough_reciprocal(1 + distance * distance) * (down[k, rows, None] * across[m])
                near[3] = 1
                total += weight * near
            q = np.moveaxis(total[:3] / total[3], 0, 2)
            linear = self._decode(photo[rows])
            relit = linear + (linear + np.float32(EPSILON)) * (q * (q + 2))
            result[rows] = self._encode(relit, photo.dtype)

        each(work, list(bands(height, width, BAND)))
        return result


def each(work: Callable[[slice], None], parts: list[slice]) -> None:
    """Do the work on every part, on as many threads as there are cores: NumPy lets others run meanwhile."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if min(cores, len(parts)) < 2:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(min(cores, len(parts), MOST_THREADS)) as pool:
        list(pool.map(work, parts))


def _weighted(light: Picture, mask: Picture) -> FloatArray:
    """Return light * mask and mask, (rows, W, 4), with 0 for light that the mask leaves unspecified."""
    if mask.dtype != np.float32:
        mask = mask * np.float32(1 / np.iinfo(mask.dtype).max)
    linear = light if light.dtype == np.float32 else decode_table(light.dtype)[light]
    weight = np.where(mask > 0, np.maximum(mask, np.float32(FAINTEST)), 0)[..., None]
    return np.concatenate([np.where(weight > 0, linear, np.float32(0)) * weight, weight], 2)
