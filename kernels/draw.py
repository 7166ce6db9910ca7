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
from dior_rt.kernels.types import FloatArray, Stroke, Strokes

#: Side in pixels of the square tiles for which segments are listed.
TILE = 32
#: The same for NumPy, which gains by small tiles what it loses by listing more of them.
SMALL_TILE = 8
#: Pairs of a tile and a segment that NumPy works on at a time: what they need stays in the processor's cache.
CHUNK = 1 << 11
#: A stroke of more points is simplified, by less than BLUR pixels.
MANY, BLUR = 1000, 1 / 64
#: The record that draw.cl calls Segment.
SEGMENT = np.dtype("(4,)f4, f4, f4, f4, i4")
SEGMENT.names = ("ends", "radius", "softness", "strength", "stroke")


def segments(stroke: Stroke, size: tuple[int, int]) -> FloatArray:
    """Return the ends x0, y0, x1, y1 of the stroke's segments, (n, 4) float32. A dot has length 0.

    Parts too far from a picture of (H, W) pixels to touch it are cut away (Liang & Barsky, 1984), so that
    distant ends do not cost float32 accuracy.
    """
    points = simplify(np.asarray(stroke.points, np.float64))
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


def simplify(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The points without those that a line of very many does not need.

    The line moves by less than BLUR. Each pass drops every second point that lies on the way between its
    neighbours, and may err by half as much as the one before.
    """
    allowed = BLUR / 2
    while len(points) > MANY:
        start, middle, end = points[:-2:2], points[1:-1:2], points[2::2]
        ends = np.concatenate([start, end], axis=1).T
        off = distance_squared(ends, *middle.T) <= allowed**2
        if off.sum() < len(points) / 100:
            break
        keep = np.ones(len(points), bool)
        keep[1:-1:2] = ~off
        points, allowed = points[keep], allowed / 2
    return points


def radius(stroke: Stroke) -> float:
    """Return half the drawn width, at least half a pixel."""
    return max(stroke.width, 1.0) / 2


def strength(stroke: Stroke) -> float:
    """Return the coverage in the middle: below 1 for a stroke thinner than a pixel."""
    return min(max(stroke.width, FAINTEST), 1.0)


def distance_squared(segment: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Squared distance of the points (x, y) to the segment (x0, y0, x1, y1); many of either broadcast."""
    x0, y0, x1, y1 = segment
    dx, dy = x1 - x0, y1 - y0
    length = dx * dx + dy * dy
    px, py = x - x0, y - y0
    along = np.clip((px * dx + py * dy) / np.where(length > 0, length, np.float32(1)), 0, 1)
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
    parts, segment, tile, begun = [], [], [], 0
    for number, stroke in enumerate(strokes):
        ends = segments(stroke, size)
        record = np.empty(len(ends), SEGMENT)
        record["ends"], record["radius"], record["softness"] = ends, radius(stroke), stroke.softness
        record["strength"], record["stroke"] = strength(stroke), number
        parts.append(record)
        which, where = touched_tiles(ends, radius(stroke) + 1, TILE, rows, columns)
        segment.append(which + begun)
        tile.append(where)
        begun += len(ends)
    segments_of, tiles = np.concatenate(segment), np.concatenate(tile)
    order = np.argsort(tiles, kind="stable")
    # One segment and one entry more than there are, for no buffer may be empty.
    return Plan(
        np.concatenate([*parts, np.zeros(1, SEGMENT)]),
        np.array([[*stroke.light, 1.0] for stroke in strokes], np.float32),
        np.searchsorted(tiles[order], np.arange(rows * columns + 1)).astype(np.int32),
        np.append(segments_of[order], 0).astype(np.int32),
    )


def touched_tiles(
    ends: FloatArray, margin: float, side: int, rows: int, columns: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Which segments (n, 4) may be the nearest to a pixel of which tiles, and nearer than the margin.

    side: of a tile, of which there are rows x columns. Returns segments and tiles, pairwise, sorted by tile.
    """
    x0, y0, x1, y1 = (ends[:, i].astype(np.float64) for i in range(4))
    # Rows of tiles that a segment passes; of each row, the columns between its way in and its way out.
    top = np.clip((np.minimum(y0, y1) - margin) // side, 0, rows).astype(np.int64)
    bottom = np.clip((np.maximum(y0, y1) + margin) // side + 1, 0, rows).astype(np.int64)
    which, row = _ranges(top, bottom)
    low, high = row * side - margin, (row + 1) * side + margin
    x, y, way_x, way_y = x0[which], y0[which], (x1 - x0)[which], (y1 - y0)[which]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.sort(np.stack([(low - y) / way_y, (high - y) / way_y]), axis=0)
    shares = np.where(way_y == 0, [[0.0], [1.0]], np.clip(shares, 0, 1))
    reached = np.sort(x + shares * way_x, axis=0)
    left = np.clip((reached[0] - margin) // side, 0, columns).astype(np.int64)
    right = np.clip((reached[1] + margin) // side + 1, 0, columns).astype(np.int64)
    pair, column = _ranges(left, right)
    which, row = which[pair], row[pair]
    middle = [((place + 0.5) * side).astype(np.float32) for place in (column, row)]
    distance = np.sqrt(distance_squared(ends[which].T, *middle))
    half = side * np.sqrt(0.5)
    near = distance <= margin + half
    which, tile, distance = which[near], (row * columns + column)[near], distance[near]
    order = np.argsort(tile, kind="stable")
    which, tile, distance = which[order], tile[order], distance[order]
    if len(
        tile
    ):  # a segment farther from a tile than another, by more than the tile is wide, is nowhere nearest
        first = np.flatnonzero(np.diff(tile, prepend=-1))
        least = np.repeat(np.minimum.reduceat(distance, first), np.diff(first, append=len(tile)))
        nearest = distance <= least + 2 * half + 0.01
        which, tile = which[nearest], tile[nearest]
    return which, tile


def _ranges(
    first: npt.NDArray[np.int64], stop: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The numbers of many ranges one after another: which range, and the number."""
    count = np.maximum(stop - first, 0)
    which = np.repeat(np.arange(len(count)), count)
    begins = np.cumsum(count) - count
    return which, np.arange(len(which)) - begins[which] + first[which]


# NumPy's way: tile by tile, as draw.cl does it pixel by pixel


def paint(strokes: Sequence[Stroke], size: tuple[int, int]) -> Strokes:
    """Strokes over a picture of (H, W) pixels."""
    rows, columns = (-(-side // SMALL_TILE) for side in size)
    shape = rows, SMALL_TILE, columns, SMALL_TILE
    light, mask = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    for stroke in strokes:
        ends = segments(stroke, size)
        which, tile = touched_tiles(ends, radius(stroke) + 1, SMALL_TILE, rows, columns)
        if not len(tile):
            continue
        tiles, nearest = _nearest(ends, which, tile, columns)
        cover = coverage(stroke, np.sqrt(nearest, out=nearest))
        down, across = tiles // columns, tiles % columns
        under = light[down, :, across]
        light[down, :, across] = under + cover[..., None] * (np.array(stroke.light, np.float32) - under)
        under = mask[down, :, across]
        mask[down, :, across] = under + cover * (1 - under)
    height, width = size
    mask = mask.reshape(rows * SMALL_TILE, -1)[:height, :width].copy()
    light = light.reshape(rows * SMALL_TILE, -1, 3)[:height, :width].copy()
    np.divide(light, mask[..., None], out=light, where=mask[..., None] > 0)
    return Strokes(light, mask)


def _nearest(
    ends: FloatArray, which: npt.NDArray[np.int64], tile: npt.NDArray[np.int64], columns: int
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """The tiles that are touched, and the squared distances of their pixels, (tiles, side, side)."""
    tiles, place = np.unique(tile, return_inverse=True)
    nearest = np.full((len(tiles), SMALL_TILE, SMALL_TILE), np.inf, np.float32)
    inside = np.arange(SMALL_TILE, dtype=np.float32) + np.float32(0.5)
    for begin in range(0, len(tile), CHUNK):
        part = slice(begin, begin + CHUNK)
        x = (tile[part] % columns * SMALL_TILE).astype(np.float32)[:, None, None] + inside
        y = (tile[part] // columns * SMALL_TILE).astype(np.float32)[:, None, None] + inside[:, None]
        distance = distance_squared(ends[which[part]].T[:, :, None, None], x, y)
        first = np.flatnonzero(np.diff(place[part], prepend=-1))
        into = place[part][first]
        nearest[into] = np.minimum(nearest[into], np.minimum.reduceat(distance, first, axis=0))
    return tiles, nearest
