"""Make a synthetic photo with strokes, the same on every machine, for benchmarks without photos."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from dior_rt.bench.worker import Pair
from dior_rt.images.photo import Photo, write_photo

#: Coordinates are fractions of the width and the height; widths are fractions of the width.
STROKES = (
    ([(0.15, 0.25), (0.25, 0.6), (0.2, 0.8)], 0.05, (1.0, 0.7, 0.35), 2.5),
    ([(0.7, 0.2), (0.8, 0.5)], 0.06, (0.1, 0.15, 0.3), 0.5),
    ([(0.45, 0.75), (0.6, 0.7)], 0.04, (0.9, 0.9, 1.0), 1.0),
)


def write_scene(folder: Path, megapixels: float) -> Pair:
    """Write a 3:2 photo of shaded balls before a textured wall lit from the left, and strokes for it."""
    height = max(1, round(math.sqrt(megapixels * 1e6 / 1.5)))
    width = max(1, round(1.5 * height))
    photo, strokes = folder / f"synthetic-{megapixels:g}mp.png", folder / "strokes.json"
    write_photo(photo, Photo(_photo(height, width)), {})
    lines = [
        {
            "points": [[x * width, y * height] for x, y in points],
            "width": max(1.0, share * width),
            "color": color,
            "intensity": intensity,
        }
        for points, share, color, intensity in STROKES
    ]
    strokes.write_text(json.dumps(lines), encoding="utf-8")
    return Pair(str(photo), str(strokes))


def _photo(height: int, width: int) -> np.ndarray:
    y, x = np.linspace(0, 1, height, dtype=np.float32)[:, None], np.linspace(0, 1.5, width, dtype=np.float32)
    texture = 0.04 * np.sin(90 * x + 20 * y) * np.sin(70 * y) + 0.03 * np.sin(400 * x) * np.sin(430 * y)
    picture = np.stack(
        [0.55 - 0.2 * x + texture, 0.5 - 0.15 * x + texture, 0.45 - 0.1 * y + texture], axis=-1
    )
    for centre, radius, albedo in (((0.4, 0.6), 0.25, (0.8, 0.3, 0.25)), ((1.0, 0.45), 0.3, (0.3, 0.5, 0.8))):
        across, down = (x - centre[0]) / radius, (y - centre[1]) / radius
        depth = np.sqrt(np.clip(1 - across**2 - down**2, 0, None))
        shade = 0.15 + 0.85 * np.clip(-0.6 * across - 0.5 * down + 0.62 * depth, 0, None)
        picture = np.where((depth > 0)[..., None], shade[..., None] * np.array(albedo, np.float32), picture)
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
