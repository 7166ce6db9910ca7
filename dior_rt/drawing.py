"""Shapes that a person draws light with, and their rasters: the vocabulary of the light desk.

    stroke      a brush's way, with pressure; hard or soft; eraser strokes take away
    fill        a closed outline, filled
    gradient    full at one end of a line, nothing at the other, over the whole picture
    glow        an ellipse, full in the middle, nothing at its border

The shapes of a layer lie over one another in order. A shape of coverage c and light D over light L of mask m
gives

    m <- m (1 - c) + c        L m <- L m (1 - c) + D c

and an eraser the same without the last term.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from dior_rt.kernels import Strokes

#: The pixels of the longer side on which shapes are drawn: far finer than a light grid, and bounded.
CANVAS: Final = 768

#: Sigma of a fill's soft edge at softness 1, as a share of the fill's longer side.
FILL_BLUR: Final = 0.15

#: The least share of its width and flow that a stroke keeps under the lightest pressure.
LIGHTEST: Final = 0.1

Point = tuple[float, float]
Array = NDArray[np.floating]


@dataclass(frozen=True)
class Paint:
    """The paint of a shape.

    color: linear RGB. intensity: a factor for the color. flow: the coverage of one pass, 0..1. softness: 0
    hard .. 1. erase: whether the shape takes light away instead.
    """

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    flow: float = 1.0
    softness: float = 0.5
    erase: bool = False

    @property
    def light(self) -> Array:
        """Return the linear RGB that the shape paints."""
        return np.asarray(self.color, np.float32) * np.float32(self.intensity)


@dataclass(frozen=True)
class Shape:
    """A shape in pixels of the photo.

    points: the path of a stroke; the outline of a fill; the two ends of a gradient; the centre of a glow and
    the ends of its two half axes. width: the width of a stroke. pressure: 0..1 for each point of a stroke, or
    empty. thins, fades: whether pressure acts on width, and on flow.
    """

    kind: Literal["stroke", "fill", "gradient", "glow"]
    points: tuple[Point, ...]
    paint: Paint = Paint()
    width: float = 1.0
    pressure: tuple[float, ...] = ()
    thins: bool = False
    fades: bool = False


def canvas_size(photo: tuple[int, int], longest: int = CANVAS) -> tuple[int, int]:
    """Return (rows, columns) of the raster for a photo of (rows, columns)."""
    scale = min(1.0, longest / max(photo))
    return max(1, round(photo[0] * scale)), max(1, round(photo[1] * scale))


class Canvas:
    """Light that is drawn shape by shape: light times mask, and the mask, on a raster for one photo."""

    def __init__(self, photo: tuple[int, int], longest: int = CANVAS) -> None:
        self.photo, self.size = photo, canvas_size(photo, longest)
        self._light = np.zeros((*self.size, 3), np.float32)
        self._mask = np.zeros(self.size, np.float32)

    def copy(self) -> Canvas:
        """Return another canvas with the same drawing."""
        other = copy(self)
        other._light, other._mask = self._light.copy(), self._mask.copy()
        return other

    def draw(self, shape: Shape) -> None:
        """Draw one shape over the earlier shapes."""
        box, coverage = _COVERAGE[shape.kind](shape, self.size, _scale(self.photo, self.size))
        if coverage.size == 0:
            return
        light, mask = self._light[box], self._mask[box]
        light *= (1 - coverage)[..., None]
        mask *= 1 - coverage
        if not shape.paint.erase:
            light += coverage[..., None] * shape.paint.light
            mask += coverage

    def strokes(self) -> Strokes:
        """Return the drawing as light and mask."""
        mask = np.clip(self._mask, 0, 1)
        weight = np.where(mask > 0, mask, 1)[..., None]
        light = np.maximum(self._light, 0) / weight
        return Strokes(light.astype(np.float32), mask.astype(np.float32))


def draw(shapes: Sequence[Shape], photo: tuple[int, int], longest: int = CANVAS) -> Strokes:
    """Rasterise the shapes of one layer for a photo of (rows, columns), at most `longest` pixels per side."""
    canvas = Canvas(photo, longest)
    for shape in shapes:
        canvas.draw(shape)
    return canvas.strokes()


@dataclass
class _Layer:
    """A layer that a Painter keeps. settled: a canvas with the first `count` shapes of the layer."""

    settled: Canvas
    count: int
    shapes: tuple[Shape, ...]
    strokes: Strokes


class Painter:
    """A cache of the rasters of layers.

    Only new shapes are drawn: the last shape grows while the pen moves.
    """

    def __init__(self, photo: tuple[int, int], kept: int = 32) -> None:
        self._photo, self._most = photo, kept
        self._layers: dict[str, _Layer] = {}

    def draw(self, name: str, shapes: Sequence[Shape]) -> Strokes:
        """Return the raster of a layer by its name.

        It is the same object as long as the shapes are the same.
        """
        shapes = tuple(shapes)
        layer = self._layers.pop(name, None)
        if layer is None or layer.shapes != shapes:
            layer = self._drawn(shapes, layer)
        self._layers[name] = layer
        while len(self._layers) > self._most:
            del self._layers[next(iter(self._layers))]
        return layer.strokes

    def _drawn(self, shapes: tuple[Shape, ...], layer: _Layer | None) -> _Layer:
        settled, count = Canvas(self._photo), 0
        last = max(0, len(shapes) - 1)
        if layer and layer.count <= last and layer.shapes[: layer.count] == shapes[: layer.count]:
            settled, count = layer.settled, layer.count
        for shape in shapes[count:last]:
            settled.draw(shape)
        canvas = settled.copy()
        for shape in shapes[last:]:
            canvas.draw(shape)
        return _Layer(settled, last, shapes, canvas.strokes())


Box = tuple[slice, slice]
Covered = tuple[Box, Array]


def _scale(photo: tuple[int, int], size: tuple[int, int]) -> Array:
    """Return the canvas's pixels per pixel of the photo, (across, down)."""
    return np.array([size[1] / photo[1], size[0] / photo[0]])


def _stroke(shape: Shape, size: tuple[int, int], scale: Array) -> Covered:
    points = np.asarray(shape.points, np.float64) * scale
    pressure = np.asarray(shape.pressure or [1.0] * len(points))
    lightness = LIGHTEST + (1 - LIGHTEST) * np.clip(pressure, 0, 1)
    radii = shape.width * np.sqrt(scale.prod()) / 2 * (lightness if shape.thins else np.ones(len(points)))
    flows = shape.paint.flow * (lightness if shape.fades else np.ones(len(points)))
    if len(points) == 1:
        points, radii, flows = (np.repeat(a, 2, 0) for a in (points, radii, flows))
    box = _box(points, float(radii.max()) + 1, size)
    coverage = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start), np.float32)
    if coverage.size == 0:
        return box, coverage
    for i in range(len(points) - 1):
        part = _box(points[i : i + 2], float(radii[i : i + 2].max()) + 1, size)
        inner = tuple(slice(a.start - b.start, a.stop - b.start) for a, b in zip(part, box, strict=True))
        if (seen := coverage[inner]).size:
            np.maximum(
                seen, _capsule(part, points[i : i + 2], radii[i : i + 2], flows[i : i + 2], shape), out=seen
            )
    return box, coverage


def _capsule(box: Box, ends: Array, radii: Array, flows: Array, shape: Shape) -> Array:
    """Return the coverage of one piece of a stroke, along which radius and flow change linearly."""
    x, y = _centres(box)
    (x0, y0), (dx, dy) = ends[0], ends[1] - ends[0]
    length = dx * dx + dy * dy
    along = np.clip(((x - x0) * dx + (y - y0) * dy) / (length or 1), 0, 1)
    distance = np.hypot(x - x0 - along * dx, y - y0 - along * dy)
    radius = np.maximum(radii[0] + along * (radii[1] - radii[0]), 0.5)
    flow = flows[0] + along * (flows[1] - flows[0])
    soft = shape.paint.softness
    return (flow * _edge((radius + 0.5 - distance) / (1 + soft * radius), soft)).astype(np.float32)


def _edge(t: Array, softness: float) -> Array:
    """Return a ramp 0..1 for a soft edge. Its slope is 0 at both ends."""
    t = np.clip(t, 0, 1)
    return t + softness * (t * t * (3 - 2 * t) - t)


def _fill(shape: Shape, size: tuple[int, int], scale: Array) -> Covered:
    points = np.asarray(shape.points, np.float64) * scale
    fine = 2  # samples per side of a pixel
    blur = shape.paint.softness * FILL_BLUR * float(np.ptp(points, axis=0).max(initial=0))
    box = _box(points, 2 * blur + 1, size)
    height, width = (side.stop - side.start for side in box)
    if min(height, width) <= 0 or len(points) < 3:
        return box, np.zeros((0, 0), np.float32)
    image = Image.new("L", (width * fine, height * fine))
    corner = np.array([box[1].start, box[0].start])
    ImageDraw.Draw(image).polygon([tuple(p) for p in (points - corner) * fine - 0.5], fill=255)
    coverage = np.asarray(image, np.float32).reshape(height, fine, width, fine).mean(axis=(1, 3)) / 255
    return box, shape.paint.flow * _blurred(coverage, blur)


def _gradient(shape: Shape, size: tuple[int, int], scale: Array) -> Covered:
    start, end = (np.asarray(p) * scale for p in shape.points[:2])
    box = slice(0, size[0]), slice(0, size[1])
    x, y = _centres(box)
    way = end - start
    along = ((x - start[0]) * way[0] + (y - start[1]) * way[1]) / max(float(way @ way), 1e-9)
    return box, (shape.paint.flow * _edge(1 - along, 1.0)).astype(np.float32)


def _glow(shape: Shape, size: tuple[int, int], scale: Array) -> Covered:
    centre, *ends = (np.asarray(p) * scale for p in shape.points[:3])
    axes = np.stack([end - centre for end in ends], axis=1)
    if abs(np.linalg.det(axes)) < 1e-9:
        return (slice(0, 0), slice(0, 0)), np.zeros((0, 0), np.float32)
    extent = np.sqrt((axes**2).sum(axis=1))
    box = _box(np.stack([centre - extent, centre + extent]), 1.0, size)
    x, y = _centres(box)
    inverse = np.linalg.inv(axes)
    px, py = x - centre[0], y - centre[1]
    distance = np.hypot(inverse[0, 0] * px + inverse[0, 1] * py, inverse[1, 0] * px + inverse[1, 1] * py)
    soft = max(shape.paint.softness, 0.02)
    return box, (shape.paint.flow * _edge((1 - distance) / soft, 1.0)).astype(np.float32)


_COVERAGE: Final = {"stroke": _stroke, "fill": _fill, "gradient": _gradient, "glow": _glow}


def _box(points: Array, margin: float, size: tuple[int, int]) -> Box:
    """Return the part of the canvas that the points and a margin around them touch. It may be empty."""
    low = np.floor(points.min(axis=0) - margin)
    high = np.ceil(points.max(axis=0) + margin)
    left, top = (int(np.clip(low[i], 0, size[1 - i])) for i in (0, 1))
    right, bottom = (int(np.clip(high[i], 0, size[1 - i])) for i in (0, 1))
    return slice(top, max(top, bottom)), slice(left, max(left, right))


def _centres(box: Box) -> tuple[Array, Array]:
    """Return x (1, columns) and y (rows, 1) of the pixels' centres."""
    y, x = (np.arange(side.start, side.stop) + 0.5 for side in box)
    return x[None, :], y[:, None]


def _blurred(coverage: Array, sigma: float) -> Array:
    if sigma < 0.3:
        return coverage
    reach = int(np.ceil(2.5 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2).astype(np.float32)
    kernel /= kernel.sum()
    for axis in (0, 1):
        padded = np.pad(coverage, [(reach, reach) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        size = coverage.shape[axis]
        coverage = sum(k * np.take(padded, range(i, i + size), axis) for i, k in enumerate(kernel))
    return np.asarray(coverage, np.float32)
