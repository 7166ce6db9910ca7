"""Choose which part of a dense Lumi map a person might have drawn.

Only the host draws random numbers, as uniform doubles of PCG64. Integer arithmetic alone turns its choices
(a lattice of cells, a list of discs in sixteenths of a pixel) into a mask. So a seed gives the same mask on
every device, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.types import FloatArray

#: Discs are placed in units of 1 / UNITS pixels.
UNITS = 16
MAX_STROKES = 8
WIDTHS = (0.015, 0.08)  # of the shorter side
LENGTHS = (0.05, 0.8)  # of the shorter side
CELLS = (1 / 32, 1 / 3)  # of the shorter side
DROPS = (0.1, 0.9)  # of the cells
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class Lattice:
    """Square cells of `cell` pixels; (oy, ox) is cut off the first one. keep: (rows, columns) bool."""

    cell: int
    oy: int
    ox: int
    keep: npt.NDArray[np.bool_]


def draw_lattice(height: int, width: int, seed: int) -> Lattice:
    """Return a lattice of random size and position that keeps a random share of its cells, at least one."""
    rng = np.random.Generator(np.random.PCG64(seed))
    cell = max(1, round(_log_uniform(rng.random(), CELLS) * min(height, width)))
    oy, ox = int(rng.random() * cell), int(rng.random() * cell)
    drop = DROPS[0] + rng.random() * (DROPS[1] - DROPS[0])
    chance = rng.random((-(-(height + oy) // cell), -(-(width + ox) // cell)))
    return Lattice(cell, oy, ox, chance >= min(drop, chance.max()))


@dataclass(frozen=True)
class Discs:
    """Overlapping discs that form the strokes: centres x, y and radius, int64, in 1 / UNITS pixels.

    Pixel (i, j), whose centre is at (UNITS * j + UNITS / 2, UNITS * i + UNITS / 2), is drawn if its
    squared distance to a disc's centre is at most the squared radius.
    """

    x: npt.NDArray[np.int64]
    y: npt.NDArray[np.int64]
    radius: npt.NDArray[np.int64]


def draw_walks(lumi: FloatArray, seed: int, interest: FloatArray | None) -> Discs:
    """Return one to eight freehand strokes: random walks whose direction drifts, reflected at the borders.

    They start alternately in the brightest and the darkest third of the map by luminance. If `interest` (H,
    W) >= 0 is not 0 everywhere, they start at pixels drawn in proportion to it.
    """
    height, width = lumi.shape[:2]
    side = min(height, width)
    rng = np.random.Generator(np.random.PCG64(seed))
    count = 1 + int(rng.random() * MAX_STROKES)
    starts = _starts(lumi, interest, rng.random((count, 2)), bright_first=rng.random() < 0.5)
    walks = []
    for start, (wide, long, heading) in zip(starts, rng.random((count, 3)), strict=True):
        radius = max(_log_uniform(wide, WIDTHS) * side, 1.0) / 2
        step = max(radius / 2, 0.5)
        steps = int(_log_uniform(long, LENGTHS) * side / step)
        # The direction drifts by about a radian per fifth of the shorter side, for any step.
        drift = (rng.random(steps) - 0.5) * np.sqrt(12 * step / (0.2 * side))
        angle = 2 * np.pi * heading + np.cumsum(drift)
        centre = np.array([start % width, start // width]) + 0.5
        path = np.cumsum(step * np.stack([np.cos(angle), np.sin(angle)], 1), 0) + centre
        path = _reflect(np.concatenate([centre[None], path]), np.array([width, height]))
        # A centre may be half a diagonal from the nearest pixel centre: a smaller disc could miss all of
        # them.
        least = 0.75
        walks.append(np.column_stack([path, np.full(steps + 1, max(radius, least))]))
    x, y, radius = np.rint(np.concatenate(walks).T * UNITS).astype(np.int64)
    return Discs(x, y, radius)


def spans(discs: Discs, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the spans that each disc fills: (row, first column, one past the last column), clipped, int64.

    On the row at dy from the centre the half chord is floor(sqrt(radius^2 - dy^2)), which is exact here: the
    arguments are below 2^52, where the float64 square root of an integer never rounds up to the next integer.
    """
    reach = int(discs.radius.max()) // UNITS + 1
    row = discs.y[:, None] // UNITS + np.arange(-reach, reach + 1)
    dy = row * UNITS + UNITS // 2 - discs.y[:, None]
    inside = discs.radius[:, None] ** 2 - dy**2
    chord = np.sqrt(np.maximum(inside, 0)).astype(np.int64)
    first = np.maximum(-(-(discs.x[:, None] - chord - UNITS // 2) // UNITS), 0)
    stop = np.minimum((discs.x[:, None] + chord - UNITS // 2) // UNITS + 1, width)
    drawn = (inside >= 0) & (row >= 0) & (row < height) & (first < stop)
    return row[drawn], first[drawn], stop[drawn]


def _starts(
    lumi: FloatArray, interest: FloatArray | None, draws: np.ndarray, bright_first: bool
) -> list[int]:
    """Return flat indices of start pixels. draws: (count, 2), uniform in 0..1."""
    if interest is not None and interest.any():
        total = np.cumsum(interest, dtype=np.float64)
        # side="right" skips pixels of interest 0, which do not raise the running total.
        found = np.searchsorted(total, draws[:, 0] * total[-1], side="right")
        return np.minimum(found, int(np.flatnonzero(interest)[-1])).tolist()
    luminance = (lumi @ LUMINANCE).ravel()
    low, high = np.partition(luminance, [luminance.size // 3, luminance.size * 2 // 3])[
        [luminance.size // 3, luminance.size * 2 // 3]
    ]
    dark, bright = np.flatnonzero(luminance <= low), np.flatnonzero(luminance >= high)
    regions = (bright, dark) if bright_first else (dark, bright)
    return [
        int(regions[i % 2][int(draw * regions[i % 2].size)]) for i, draw in enumerate(draws[:, 0].tolist())
    ]


def _log_uniform(draw: float, between: tuple[float, float]) -> float:
    return float(between[0] * (between[1] / between[0]) ** draw)


def _reflect(path: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Reflect a path into 0..size along each axis."""
    return size - np.abs(path % (2 * size) - size)
