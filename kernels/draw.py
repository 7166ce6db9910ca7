"""Brush strokes as capsules: what both rasterisers draw.

The coverage of a pixel whose centre is at distance d from a stroke's centre line is, with r = max(width, 1)
/ 2,

    t = clip((r + 1/2 - d) / (1 + softness * r), 0, 1)
    coverage = min(width, 1) * (t + softness * (t^2 (3 - 2 t) - t))

A hard edge is a ramp one pixel wide; a soft one falls smoothly from the centre line's neighbourhood to the
border. A stroke thinner than a pixel is drawn a pixel wide and as much fainter. Strokes lie over one
another in order: value * mask and mask are blended over, then the value is un-premultiplied, so it never
darkens at an edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dior_rt.kernels.types import FloatArray, Stroke


def segments(stroke: Stroke) -> FloatArray:
    """(n, 4) float32: the ends x0, y0, x1, y1 of the stroke's n >= 1 segments; a dot is one of length 0."""
    points = np.asarray(stroke.points, np.float32)
    if len(points) == 1:
        points = np.repeat(points, 2, 0)
    return np.concatenate([points[:-1], points[1:]], 1)


def radius(stroke: Stroke) -> float:
    """Half the width that is drawn: at least half a pixel."""
    return max(stroke.width, 1.0) / 2


def distance_squared(segment: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Squared distance of the points (x, y) to one segment (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = segment
    dx, dy = x1 - x0, y1 - y0
    length = dx * dx + dy * dy
    px, py = x - x0, y - y0
    along = np.clip((px * dx + py * dy) / (length if length > 0 else np.float32(1)), 0, 1)
    return (px - along * dx) ** 2 + (py - along * dy) ** 2


def coverage(stroke: Stroke, distance: FloatArray) -> FloatArray:
    """How much of a pixel is covered, by its distance from the centre line; see the module's equation."""
    r, soft = radius(stroke), stroke.softness
    t = np.clip((r + 0.5 - distance) / (1 + soft * r), 0, 1).astype(np.float32)
    smooth = t * t * (3 - 2 * t)
    return np.float32(min(stroke.width, 1.0)) * (t + np.float32(soft) * (smooth - t))


def reach(strokes: Sequence[Stroke]) -> list[tuple[float, float]]:
    """The first and last y that each stroke touches."""
    result = []
    for stroke in strokes:
        ys = [y for _, y in stroke.points]
        margin = radius(stroke) + 0.5
        result.append((min(ys) - margin, max(ys) + margin))
    return result
