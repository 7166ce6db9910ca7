"""The pixel operations in float64, the one reference that every test of them compares with.

Written from the equations in docs/kernels.md and the modules' docstrings, without tables, bands,
reciprocals by exponent arithmetic in float32, or fused operations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: The floor that is added to light before a quotient, and the width of the edge-aware weight in lightness.
E, SIGMA = 0.02, 0.03


def decode(v: Any) -> Array:
    """sRGB -> linear light."""
    v = np.asarray(v, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4)


def encode(x: Any) -> Array:
    """Linear light -> sRGB."""
    x = np.asarray(x, np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def unit(picture: NDArray) -> Array:
    """Samples of any dtype -> 0..1."""
    return picture / (1.0 if picture.dtype.kind == "f" else float(np.iinfo(picture.dtype).max))


def overlaps(pixels: int, cells: int) -> Array:
    """(cells, pixels): how much of each pixel, 0..1, lies in each cell."""
    edges, pixel = np.arange(cells + 1)[:, None] * pixels / cells, np.arange(pixels)
    return np.clip(np.minimum(edges[1:], pixel + 1) - np.maximum(edges[:-1], pixel), 0, 1)


def light_of(picture: NDArray) -> Array:
    """sRGB samples of any dtype -> linear light."""
    if picture.dtype.kind == "f":
        return decode(picture)
    return decode(unit(np.arange(np.iinfo(picture.dtype).max + 1).astype(picture.dtype)))[picture]


def area_sum(values: Array, grid: tuple[int, int]) -> Array:
    """(H, W, C) -> (h, w, C): the sum over each cell's area."""
    down, across = overlaps(values.shape[0], grid[0]), overlaps(values.shape[1], grid[1])
    return np.einsum("jx,ixc->ijc", across, np.tensordot(down, values, 1))


def reduce_photo(photo: NDArray, grid: tuple[int, int]) -> Array:
    """The mean linear light of each cell; of many rows, some at a time."""
    (height, width), total = photo.shape[:2], np.zeros((grid[0], photo.shape[1], 3))
    down, across = overlaps(height, grid[0]), overlaps(width, grid[1])
    for top in range(0, height, 500):
        rows = slice(top, top + 500)
        total += np.tensordot(down[:, rows], light_of(photo[rows]), 1)
    return np.einsum("jx,ixc->ijc", across, total) * (grid[0] * grid[1] / (height * width))


def reduce_strokes(light: NDArray, mask: NDArray, grid: tuple[int, int]) -> tuple[Array, Array]:
    """(light, mask) of each cell; light is linear."""
    weight = mask.astype(np.float64)[..., None]
    light = np.where(weight > 0, light.astype(np.float64), 0)
    total, area = area_sum(light * weight, grid), area_sum(weight, grid)
    drawn = area[..., 0] > 1e-60
    return np.divide(total, area, out=np.zeros_like(total), where=drawn[..., None]), drawn


def transfer(
    photo: NDArray,
    source: Array,
    relit: Array,
    size: tuple[int, int] | None = None,
    corner: tuple[int, int] = (0, 0),
) -> Array:
    """The photo, 0..1 and not clipped, under the light that turns the grid `source` into `relit`.

    size, corner: where `photo` is part of a larger one, that one's (H, W) and the part's first pixel.
    """
    (height, width), (rows, columns) = size or photo.shape[:2], source.shape[:2]
    v = unit(photo)
    g, cell_g = _lightness(v), _lightness(encode(source))
    root = _sharpened(np.sqrt((relit + E) / (source + E)))
    y = ((corner[0] + np.arange(v.shape[0]) + 0.5) * rows / height - 0.5)[:, None]
    x = (corner[1] + np.arange(v.shape[1]) + 0.5) * columns / width - 0.5
    i, j = np.floor(y + 0.5).astype(int), np.floor(x + 0.5).astype(int)
    total, weights = np.zeros_like(v), np.zeros((*v.shape[:2], 1))
    for di, dj in np.ndindex(3, 3):
        near = i + di - 1, j + dj - 1
        cell = np.clip(near[0], 0, rows - 1), np.clip(near[1], 0, columns - 1)
        likeness = rough_reciprocal(1 + ((g - cell_g[cell]) / SIGMA) ** 2)
        weight = (_spline(y - near[0]) * _spline(x - near[1]) * likeness)[..., None]
        total += weight * root[cell]
        weights += weight
    light = light_of(photo)
    return encode((light + E) * (total / weights) ** 2 - E)


def rough_reciprocal(q: Array) -> Array:
    """1 / q with log2 and exp2 replaced by their chords between powers of two."""
    mantissa, exponent = np.frexp(q)
    log = 0x7EF311C7 / 2**23 - 254 - (exponent - 1 + 2 * mantissa - 1)
    return np.exp2(np.floor(log)) * (1 + log - np.floor(log))


def _lightness(encoded: Array) -> Array:
    return np.clip(encoded @ [0.25, 0.5, 0.25], 0, 1)


def _sharpened(values: Array) -> Array:
    """The values plus what the spline will blur of them, within the range of the 3 x 3 neighbours."""
    rows, columns = values.shape[:2]
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.stack([padded[i : i + rows, j : j + columns] for i, j in np.ndindex(3, 3)])
    kernel = np.outer([1, 4, 1], [1, 4, 1]).ravel() / 36
    return np.clip(2 * values - np.tensordot(kernel, around, 1), around.min(0), around.max(0))


def _spline(d: Array) -> Array:
    d = np.abs(d)
    return np.where(d < 0.5, 0.75 - d * d, 0.5 * (1.5 - d) ** 2)
