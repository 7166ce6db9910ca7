"""The NumPy twin of every kernel: what runs where there is no OpenCL, and what OpenCL is compared against."""

from __future__ import annotations

import numpy as np

from dior_rt.kernels import draw
from dior_rt.kernels.color import ENCODED_KNEE, LINEAR_KNEE, decode_table, encode_table
from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.resample import area_weights, bands, taps
from dior_rt.kernels.sparsify import Discs, Lattice, spans
from dior_rt.kernels.transfer import EPSILON, LIGHTNESS, Light
from dior_rt.kernels.types import FloatArray, Picture, Stroke, Strokes


class NumpyOps(Ops):
    """Vectorised NumPy, in bands of rows."""

    name = "numpy"

    def _decode(self, picture: Picture) -> FloatArray:
        if picture.dtype != np.float32:
            return decode_table(picture.dtype)[picture]
        power = ((np.maximum(picture, np.float32(ENCODED_KNEE)) + 0.055) / 1.055) ** 2.4
        return np.where(picture <= ENCODED_KNEE, picture / np.float32(12.92), power)

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        if dtype == np.float32:
            power = 1.055 * np.maximum(linear, np.float32(LINEAR_KNEE)) ** (1 / 2.4) - 0.055
            return np.where(linear <= LINEAR_KNEE, np.float32(12.92) * linear, power)
        table = encode_table(dtype)
        clipped = np.fmin(np.fmax(linear, table.floor), np.float32(1))
        code = table.start[(clipped.view(np.uint32) >> table.shift) - table.first]
        return code + (clipped >= table.threshold[code])

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        height, width = picture.shape[:2]
        down, across = area_weights(height, grid[0]), area_weights(width, grid[1])
        total = np.zeros((grid[0], width * 3), np.float32)
        for rows in bands(height, width):
            cells = down[:, rows].any(1)
            total[cells] += down[cells, rows] @ self._decode(picture[rows]).reshape(-1, width * 3)
        return across @ total.reshape(grid[0], width, 3)

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        height, width = mask.shape
        down, across = area_weights(height, grid[0]), area_weights(width, grid[1])
        total = np.zeros((grid[0], width * 4), np.float32)
        for rows in bands(height, width):
            cells = down[:, rows].any(1)
            weighted = _weighted(light[rows], mask[rows])
            total[cells] += down[cells, rows] @ weighted.reshape(-1, width * 4)
        mean = across @ total.reshape(grid[0], width, 4)
        weight = mean[..., 3:]
        value = np.divide(mean[..., :3], weight, out=np.zeros((*grid, 3), np.float32), where=weight > 0)
        return Strokes(value, (weight[..., 0] > 0).astype(np.float32))

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        height, width = size
        light, mask = np.zeros((height, width, 3), np.float32), np.zeros(size, np.float32)
        reach = draw.reach(strokes)
        for rows in bands(height, width):
            for stroke, (first, last) in zip(strokes, reach, strict=True):
                if first < rows.stop and last > rows.start:
                    _lay_over(light[rows], mask[rows], stroke, rows.start)
        np.divide(light, mask[..., None], out=light, where=mask[..., None] > 0)
        return Strokes(light, mask)

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        height, width = lumi.shape[:2]
        row = (np.arange(height) + lattice.oy) // lattice.cell
        column = (np.arange(width) + lattice.ox) // lattice.cell
        pixels = np.bincount(row)[:, None, None] * np.bincount(column)[:, None].astype(np.float32)
        first_rows, first_columns = (np.flatnonzero(np.diff(x, prepend=-1)) for x in (row, column))
        mean = np.add.reduceat(np.add.reduceat(lumi, first_rows, 0), first_columns, 1) / pixels
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

    def _transfer(self, photo: Picture, light: Light) -> Picture:
        height, width = photo.shape[:2]
        result = np.empty_like(photo, order="C", subok=False)
        upper_row, lower_row, down = taps(height, light.slope.shape[0])
        left, right, across = taps(width, light.slope.shape[1])
        down, across = down[:, None, None], across[:, None]
        model = np.concatenate([light.slope, light.offset], 2)
        for rows in bands(height, width):
            band = model[upper_row[rows]] * (1 - down[rows]) + model[lower_row[rows]] * down[rows]
            slope, offset = np.split(band[:, left] * (1 - across) + band[:, right] * across, 2, axis=2)
            scale = 1 if photo.dtype == np.float32 else np.float32(1 / np.iinfo(photo.dtype).max)
            guide = (photo[rows] @ LIGHTNESS)[..., None] * scale
            gain = np.expm1(np.clip(slope * guide + offset, light.low, light.high))
            linear = self._decode(photo[rows])
            linear += (linear + np.float32(EPSILON)) * gain
            result[rows] = self._encode(linear, photo.dtype)
        return result


def _weighted(light: Picture, mask: Picture) -> FloatArray:
    """(rows, W, 4): light * mask and mask, with 0 for the light that the mask leaves unspecified."""
    if mask.dtype != np.float32:
        mask = mask * np.float32(1 / np.iinfo(mask.dtype).max)
    linear = light if light.dtype == np.float32 else decode_table(light.dtype)[light]
    weight = mask[..., None]
    return np.concatenate([np.where(weight > 0, linear, np.float32(0)) * weight, weight], 2)


def _lay_over(light: FloatArray, mask: FloatArray, stroke: Stroke, top: int) -> None:
    """Blend one stroke over a band that starts at row `top`; light holds value * mask."""
    nearest = np.full(mask.shape, np.inf, np.float32)
    margin = draw.radius(stroke) + 1
    for segment in draw.segments(stroke):
        window = _window(segment, margin, top, mask.shape)
        y = np.arange(window[0].start, window[0].stop, dtype=np.float32)[:, None] + np.float32(top + 0.5)
        x = np.arange(window[1].start, window[1].stop, dtype=np.float32) + np.float32(0.5)
        if x.size and y.size:
            np.minimum(nearest[window], draw.distance_squared(segment, x, y), out=nearest[window])
    cover = draw.coverage(stroke, np.sqrt(nearest))
    light *= (1 - cover)[..., None]
    light += cover[..., None] * np.array(stroke.light, np.float32)
    mask *= 1 - cover
    mask += cover


def _window(segment: FloatArray, margin: float, top: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """The rows and columns of a band that come within `margin` of a segment."""
    x, y = segment[0::2], segment[1::2] - top
    rows = np.clip([np.floor(y.min() - margin), np.ceil(y.max() + margin)], 0, shape[0]).astype(int)
    columns = np.clip([np.floor(x.min() - margin), np.ceil(x.max() + margin)], 0, shape[1]).astype(int)
    return slice(*rows), slice(*columns)
