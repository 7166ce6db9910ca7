"""Cases to measure presets with: synthetic photos, and strokes on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.kernels import NumpyOps, Stroke, Strokes

SIZES = ((160, 240), (200, 200), (240, 160))
OPS = NumpyOps()


@dataclass(frozen=True)
class Case:
    """A photo (H, W, 3), uint8, sRGB, with strokes of the same size and a seed for the noise."""

    photo: NDArray[np.uint8]
    strokes: Strokes
    seed: int


def made_up(count: int) -> list[Case]:
    """Return synthetic cases: balls before a textured wall, and strokes of random colour and strength."""
    return [_made_up(np.random.default_rng([number, 71]), number) for number in range(count)]


def _made_up(rng: Generator, seed: int) -> Case:
    height, width = SIZES[rng.integers(len(SIZES))]
    y, x = np.mgrid[:height, :width].astype(np.float32) / max(height, width)
    slant, waves = rng.uniform(-0.5, 0.5, 2), rng.uniform(20, 300, 4)
    texture = 0.1 * np.sin(waves[0] * x + waves[1] * y) * np.sin(waves[2] * y - waves[3] * x)
    wall = (rng.uniform(0.3, 0.8) + slant[0] * x + slant[1] * y + texture)[..., None]
    linear = wall * rng.uniform(0.2, 0.9, 3)
    light = rng.normal(size=3) * (1, 1, 0.3) + (0, 0, 0.8)
    for _ in range(rng.integers(1, 6)):
        across, down = ((axis - rng.uniform(0.1, 0.9)) / rng.uniform(0.08, 0.3) for axis in (x, y))
        depth = np.sqrt(np.clip(1 - across**2 - down**2, 0, None))
        shade = (np.stack([across, down, depth], axis=-1) @ (light / np.linalg.norm(light))).clip(0)
        ball = (0.05 + shade[..., None]) * rng.uniform(0.1, 0.9, 3)
        linear = np.where((depth > 0)[..., None], ball, linear)
    photo = OPS.encode_srgb(linear.clip(0, 1).astype(np.float32), np.uint8)
    strokes = [_stroke(rng, height, width) for _ in range(rng.integers(1, 5))]
    return Case(photo, OPS.draw_strokes(strokes, (height, width)), seed)


def _stroke(rng: Generator, height: int, width: int) -> Stroke:
    points = rng.uniform(0.05, 0.95, (rng.integers(1, 4), 2)) * (width, height)
    return Stroke(
        points=tuple((float(x), float(y)) for x, y in points),
        width=float(rng.uniform(0.04, 0.15) * width),
        color=tuple(rng.uniform(0.1, 1, 3).tolist()),
        intensity=float(2 ** rng.uniform(-2, 1.5)),
    )
