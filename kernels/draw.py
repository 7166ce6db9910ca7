"""Brush strokes as capsules: the shape that both rasterisers draw.

The coverage of a pixel whose centre is at distance d from a stroke's centre line is, with r = max(width, 1)
/ 2,

    t = clip((r + 1/2 - d) / (1 + softness * r), 0, 1)
    coverage = clip(width, 2^-60, 1) * (t + softness * (t^2 (3 - 2 t) - t))

A hard edge is a ramp one pixel wide. A soft edge falls smoothly from near the centre line to the border. A
stroke thinner than a pixel is drawn one pixel wide and proportionally fainter. Later strokes lie over
earlier ones: value * mask and mask are blended, then the value is un-premultiplied, so it never darkens at
an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.resample import FAINTEST
from dior_rt.kernels.types import FloatArray, Stroke

#: Side in pixels of the square tiles for which segments are listed.
TILE = 32
#: The record that draw.cl calls Segment.
SEGMENT = np.dtype("(4,)f4, f4, f4, f4, i4")
SEGMENT.names = ("ends", "radius", "softness", "strength", "stroke")


def segments(stroke: Stroke, size: tuple[int, int]) -> FloatArray:
    """Return the ends x0, y0, x1, y1 of the stroke's segments, (n, 4) float32. A dot has length 0.

    Parts too far from a picture of (H, W) pixels to touch it are cut away (Liang & Barsky, 1984), so that
    distant ends do not cost float32 accuracy.
    """
    points = np.asarray(stroke.points, np.float64)
    if len(points) == 1:
        points = np.repeat(points, 2, 0)
    start, way = points[:-1], np.diff(points, axis=0)
    low, high = -radius(stroke) - 1, np.array(size[::-1]) + radius(stroke) + 1
    with np.errstate(divide="ignore", invalid="ignore"):
        # The fractions of the segment at which it enters and leaves the picture, along each axis.
        edges = np.sort(np.stack([(low - start) / way, (high - start) / way]), axis=0)
    inside = (start >= low) & (start <= high)
    edges = np.where(way == 0, np.where(inside, [[[0.0]], [[1.0]]], [[[1.0]], [[0.0]]]), edges)
    first, last = np.maximum(edges[0].max(1), 0)[:, None], np.minimum(edges[1].min(1), 1)[:, None]
    ends = np.where(last == 1, start + way, start + last * way)
    return np.concatenate([start + first * way, ends], 1)[(first <= last)[:, 0]].astype(np.float32)


def radius(stroke: Stroke) -> float:
    """Return half the drawn width, at least half a pixel."""
    return max(stroke.width, 1.0) / 2


def strength(stroke: Stroke) -> float:
    """Return the coverage in the middle: below 1 for a stroke thinner than a pixel."""
    return min(max(stroke.width, FAINTEST), 1.0)


def distance_squared(segment: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the squared distance of the points (x, y) to one segment (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = segment
    dx, dy = x1 - x0, y1 - y0
    length = dx * dx + dy * dy
    px, py = x - x0, y - y0
    along = np.clip((px * dx + py * dy) / (length if length > 0 else np.float32(1)), 0, 1)
    return (px - along * dx) ** 2 + (py - along * dy) ** 2


def coverage(stroke: Stroke, distance: FloatArray) -> FloatArray:
    """Return how much of a pixel is covered, given its distance from the centre line."""
    r, soft = radius(stroke), stroke.softness
    t = np.clip((r + 0.5 - distance) / (1 + soft * r), 0, 1).astype(np.float32)
    smooth = t * t * (3 - 2 * t)
    return np.float32(strength(stroke)) * (t + np.float32(soft) * (smooth - t))


@dataclass(frozen=True)
class Plan:
    """Strokes prepared for a device: which segments may touch which tile of TILE x TILE pixels.

    segments: one SEGMENT each. lights: (strokes, 4) float32, linear RGB and 1. The segments that may touch
    tile t (tiles in row order) are entries[first[t]:first[t + 1]], in the order of their strokes.
    """

    segments: np.ndarray
    lights: FloatArray
    first: npt.NDArray[np.int32]
    entries: npt.NDArray[np.int32]


def plan(strokes: Sequence[Stroke], size: tuple[int, int]) -> Plan:
    """Prepare at least one stroke for a picture of (H, W) pixels."""
    rows, columns = (-(-side // TILE) for side in size)
    parts, tiles = [], []
    for number, stroke in enumerate(strokes):
        ends = segments(stroke, size)
        record = np.empty(len(ends), SEGMENT)
        record["ends"], record["radius"], record["softness"] = ends, radius(stroke), stroke.softness
        record["strength"], record["stroke"] = strength(stroke), number
        parts.append(record)
        tiles += [_tiles(segment, radius(stroke) + 1, rows, columns) for segment in ends]
    segment = np.repeat(np.arange(len(tiles)), [len(touched) for touched in tiles])
    tile = np.concatenate([np.empty(0, np.int64), *tiles])
    order = np.argsort(tile, kind="stable")
    # One extra segment and entry, because OpenCL allows no empty buffer.
    return Plan(
        np.concatenate([*parts, np.zeros(1, SEGMENT)]),
        np.array([[*stroke.light, 1.0] for stroke in strokes], np.float32),
        np.searchsorted(tile[order], np.arange(rows * columns + 1)).astype(np.int32),
        np.append(segment[order], 0).astype(np.int32),
    )


def _tiles(segment: FloatArray, margin: float, rows: int, columns: int) -> np.ndarray:
    """Return the tiles whose centre is so near to the segment that it may touch one of their pixels."""
    x0, y0, x1, y1 = segment
    left, right = (min(x0, x1) - margin) // TILE, (max(x0, x1) + margin) // TILE
    top, bottom = (min(y0, y1) - margin) // TILE, (max(y0, y1) + margin) // TILE
    x = np.arange(max(left, 0), min(right + 1, columns), dtype=np.int64)
    y = np.arange(max(top, 0), min(bottom + 1, rows), dtype=np.int64)[:, None]
    middle_x, middle_y = ((at.astype(np.float32) + np.float32(0.5)) * TILE for at in (x, y))
    near = distance_squared(segment, middle_x, middle_y) <= (margin + TILE * np.sqrt(0.5)) ** 2
    return (y * columns + x)[near]
