"""The types of the kernels: a drawn stroke, rasterised strokes, a device, and the error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

#: In pixels: farther points and wider strokes are refused.
FARTHEST = 1e9
#: Times display white: stronger light is refused, since products of it leave float32's range.
STRONGEST = 1e9

FloatArray = npt.NDArray[np.float32]
Picture = npt.NDArray[Any]  # uint8, uint16 or float32


class KernelError(ValueError):
    """A named device that is not available, or a device that computes wrong results."""


@dataclass(frozen=True)
class Device:
    """An OpenCL device. index: its place in `list_devices()`; type: "gpu", "cpu", "accelerator", "other"."""

    index: int
    name: str
    platform: str
    type: str
    handle: Any


@dataclass(frozen=True)
class Stroke:
    """One stroke of the brush: a polyline with round caps. A single point is a dot.

    points: ((x, y), ...) in pixels; (0, 0) is the upper left corner of the picture, (0.5, 0.5) the centre of
    its first pixel; points may lie outside. width: pixels, > 0. color: linear RGB. intensity: the light is
    color * intensity, both >= 0. softness: the share of the half width over which the edge fades; 0 is hard.
    """

    points: tuple[tuple[float, float], ...]
    width: float
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    softness: float = 0.0

    def __post_init__(self) -> None:
        if not self.points or any(len(point) != 2 for point in self.points):
            raise ValueError("a stroke needs at least one point, each an (x, y) pair")
        if not all(abs(value) <= FARTHEST for point in self.points for value in point):
            raise ValueError(f"a stroke's points must lie within {FARTHEST:g} pixels of the corner")
        if not 0 < self.width <= FARTHEST:
            raise ValueError(f"a stroke's width must lie between 0 and {FARTHEST:g} pixels, not {self.width}")
        if len(self.color) != 3 or not all(math.isfinite(c) and c >= 0 for c in self.light):
            raise ValueError("a stroke's color must be three finite numbers >= 0, and its intensity one")
        if max(self.light) > STRONGEST:
            raise ValueError(f"a stroke's color times its intensity must be at most {STRONGEST:g}")
        if not 0 <= self.softness <= 1:
            raise ValueError(f"a stroke's softness must lie in 0..1, not {self.softness}")

    @property
    def light(self) -> tuple[float, ...]:
        """The drawn light in linear RGB: color * intensity."""
        return tuple(c * self.intensity for c in self.color)


@dataclass(frozen=True)
class Strokes:
    """A sparse Lumi map. light: (H, W, 3) float32 linear RGB >= 0; mask: (H, W) float32 in 0..1, 0 =
    unspecified."""

    light: FloatArray
    mask: FloatArray
