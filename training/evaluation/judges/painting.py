"""Strokes that judges draw, as strong as the light that a model sees under them asks for."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.kernels import Stroke, Strokes
from dior_rt.training.evaluation.control import DEFAULT_LIGHT
from dior_rt.training.evaluation.judges.models import LUMINANCE
from dior_rt.training.evaluation.judges.subjects import Point
from dior_rt.training.evaluation.metrics import Raster
from dior_rt.training.evaluation.tasks import OPS

Color = tuple[float, float, float]

WHITE: Final[Color] = (1.0, 1.0, 1.0)
BLUE: Final[Color] = (0.15, 0.35, 1.0)
FAINTEST: Final = 0.02  # estimated light below which a stroke takes DEFAULT_LIGHT as its base


def line(size: tuple[int, ...], points: tuple[Point, ...], width: float, light: tuple[float, ...]) -> Strokes:
    """Draw one stroke. size: (H, W, ...). width: pixels. light: linear RGB."""
    ends = tuple((float(x), float(y)) for x, y in points)
    return OPS.draw_strokes([Stroke(ends, width, (light[0], light[1], light[2]))], (size[0], size[1]))


def disc(size: tuple[int, ...], at: Point, radius: float) -> NDArray[np.bool_]:
    """Return the pixels (H, W) whose centres lie within `radius` of (x, y)."""
    rows, columns = np.indices(size[:2]) + 0.5
    return np.asarray(np.hypot(columns - at[0], rows - at[1]) <= radius)


def base_light(estimated: Raster, mask: NDArray) -> float:
    """Return the mean luminance that the Lumi map `estimated` has under a mask of the photo's size."""
    drawn = OPS.reduce_strokes(
        np.zeros((*mask.shape, 3), np.float32), mask.astype(np.float32), estimated.shape[:2]
    )
    local = float((estimated @ LUMINANCE)[drawn.mask > 0].mean())
    return local if local > FAINTEST else DEFAULT_LIGHT


def times(color: Color, strength: float) -> tuple[float, ...]:
    """Return the light of a colour at a strength."""
    return tuple(strength * part for part in color)
