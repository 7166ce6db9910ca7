"""Lights as layers: compose the requested light from the light on the photo and the user's drawing.

A layer acts on the light T below it; at the bottom T is S, the source Lumi map. With the drawn light D, times
the layer's strength and tint, and the coverage m in 0..1:

    set         T <- T + m (D - T)      the light here is D
    add         T <- T + m D            one more lamp; it never darkens
    multiply    T <- T + m (D T - T)    a flag (D < 1) or a gel (a coloured D)

All of it is linear light, and linear in D. D has the primaries of sRGB, and is converted to the photo's: a
gel has the colour that it gives to white light. The model gets T where a layer covers at least
`LEAST_COVERAGE` of a cell, and completes the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from dior_rt.errors import InputError
from dior_rt.flow.sampler import Array
from dior_rt.images.primaries import Matrix, convert
from dior_rt.kernels import Stroke, Strokes
from dior_rt.kernels.resample import area_weights
from dior_rt.kernels.types import STRONGEST
from dior_rt.reach import check_reach, closeness

Blend = Literal["set", "add", "multiply"]
BLENDS: Final[tuple[Blend, ...]] = get_args(Blend)

#: A cell with less coverage than this is left to the model, so that the faint rim of a soft brush sets no
#: light.
LEAST_COVERAGE: Final = 1 / 16


@dataclass(frozen=True)
class Light:
    """One layer of light.

    drawn: the light D, linear RGB, and the coverage m as its mask, of the photo's shape and any size; or
    strokes in pixels of the photo. strength, tint: factors of D, >= 0. reach: how far from the layer light
    changes, in longer sides of the photo; None leaves it to the model. on: whether the layer counts. name: a
    name for people.
    """

    drawn: Strokes | tuple[Stroke, ...]
    blend: Blend = "set"
    strength: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    reach: float | None = None
    on: bool = True
    name: str = ""

    def __post_init__(self) -> None:
        if self.blend not in BLENDS:
            raise InputError(f"A light's blend must be one of {', '.join(BLENDS)}, not {self.blend!r:.40}.")
        if not (math.isfinite(self.strength) and self.strength >= 0):
            raise InputError(f"A light's strength must be a number of at least 0, not {self.strength}.")
        if len(self.tint) != 3 or not all(math.isfinite(c) and c >= 0 for c in self.tint):
            raise InputError(f"A light's tint must be three numbers of at least 0, not {self.tint}.")
        check_reach(self.reach)


@dataclass(frozen=True)
class Cover:
    """A layer on the light grid.

    amount: each cell's mean of m D, (h, w, 3); coverage: the mean of m, (h, w).
    """

    amount: Array
    coverage: Array


@dataclass(frozen=True)
class Composed:
    """The light that the lights ask for.

    target: the light, and its mask. nearness: (h, w) in 0..1, how far each cell may follow the model; None
    lets all cells follow it fully.
    """

    target: Strokes
    nearness: Array | None


def convert_lights(lights: Sequence[Light], matrix: Matrix | None) -> list[Light]:
    """Return the lights in other primaries, by a matrix of `primaries.conversion`.

    Their tint becomes part of D.
    """
    return list(lights) if matrix is None else [_convert(light, matrix) for light in lights]


def _convert(light: Light, matrix: Matrix) -> Light:
    tint = np.asarray(light.tint)
    drawn: Strokes | tuple[Stroke, ...]
    if isinstance(light.drawn, Strokes):
        seen = np.where(light.drawn.mask[..., None] > 0, light.drawn.light, 0)
        drawn = Strokes(convert((seen * tint).astype(np.float32), matrix), light.drawn.mask)
    else:
        colors = (convert(np.asarray(stroke.color) * tint, matrix).tolist() for stroke in light.drawn)
        strokes = zip(light.drawn, colors, strict=True)
        drawn = tuple(replace(stroke, color=(r, g, b)) for stroke, (r, g, b) in strokes)
    return replace(light, drawn=drawn, tint=(1.0, 1.0, 1.0))


def cover(drawn: Strokes, grid: tuple[int, int]) -> Cover:
    """Return the mean of m D and of m over the exact area of each cell of the grid."""
    down, across = (area_weights(size, cells) for size, cells in zip(drawn.mask.shape, grid, strict=True))
    light = np.where(drawn.mask[..., None] > 0, drawn.light, 0)  # pixels without drawing may hold any value
    planes = np.concatenate([light * drawn.mask[..., None], drawn.mask[..., None]], axis=-1, dtype=np.float32)
    rows, columns = drawn.mask.shape
    narrow = across @ (down @ planes.reshape(rows, columns * 4)).reshape(grid[0], columns, 4)
    return Cover(np.ascontiguousarray(narrow[..., :3]), np.clip(narrow[..., 3], 0, 1))


def compose(
    source: Array, lights: Sequence[Light], covers: Sequence[Cover], matrix: Matrix | None = None
) -> Composed:
    """Compose the light of all lights that are on, the first at the bottom. source: the Lumi map (h, w, 3).

    covers: the lights on the grid of the source, one for each. matrix: from the lights' primaries to those of
    the source, see `primaries.conversion`.
    """
    grid = source.shape[0], source.shape[1]
    target = source.astype(np.float32)
    mask, nearness = np.zeros(grid, np.float32), np.zeros(grid, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for light, layer in zip(lights, covers, strict=True):
            touched = layer.coverage >= LEAST_COVERAGE
            if not light.on or not touched.any():
                continue
            target = np.where(touched[..., None], blend(target, light, layer, matrix), target)
            mask[touched] = 1
            near = np.float32(1) if light.reach is None else closeness(touched, light.reach)
            nearness = np.maximum(nearness, near)
    if not (target <= STRONGEST).all():  # nor where it is no number
        raise InputError("The lights are too strong to be computed with; lower their strength.")
    return Composed(Strokes(target, mask), None if (nearness == 1).all() else nearness)


def blend(below: Array, light: Light, layer: Cover, matrix: Matrix | None = None) -> Array:
    """Return the light after one layer, by the equations above. matrix: as `compose` takes it."""
    amount = layer.amount * np.float32(light.strength) * np.asarray(light.tint, np.float32)
    amount = convert(amount, matrix)
    if light.blend == "add":
        return below + amount
    kept = below * (1 - layer.coverage[..., None])
    return kept + (amount if light.blend == "set" else amount * below)
