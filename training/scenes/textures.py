"""Procedural textures: small linear RGB rasters of reflectance in [0.02, 0.9], drawn from a seed."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Raster = NDArray[np.float32]

SIZE = 128


def rainbow(hue: float) -> NDArray[np.float64]:
    """Return the fully saturated RGB of a hue in 0..1: HSV with saturation and value 1."""
    return np.clip(np.abs((hue * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)


def color(rng: Generator) -> Raster:
    """Return one reflectance (3,): any hue, mostly low saturation as in paint, and the values of real
    surfaces.
    """
    hue, saturation, value = rng.uniform(), rng.beta(1.2, 2.0), rng.uniform(0.05, 0.85)
    ramp = rainbow(hue)
    return np.clip(value * (1 - saturation * (1 - ramp)), 0.02, 0.9).astype(np.float32)


def noise(rng: Generator, size: int = SIZE, octaves: int = 5, start: int = 3) -> Raster:
    """Return (size, size) fractal value noise that tiles, in [0, 1]."""
    total = np.zeros((size, size))
    for octave in range(octaves):
        cells = start * 2**octave
        if cells > size:
            break
        lattice = rng.uniform(size=(cells, cells))
        total += _smooth_upsample(lattice, size) * 0.5**octave
    low, high = total.min(), total.max()
    return ((total - low) / max(high - low, 1e-6)).astype(np.float32)


def _smooth_upsample(lattice: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return a periodic interpolation with the smoothstep weight 3t^2 - 2t^3."""
    cells = lattice.shape[0]
    at = np.arange(size) * cells / size
    low = at.astype(int)
    t = at - low
    t = t * t * (3 - 2 * t)
    rows = lattice[low] * (1 - t)[:, None] + lattice[(low + 1) % cells] * t[:, None]
    return rows[:, low] * (1 - t) + rows[:, (low + 1) % cells] * t


def texture(rng: Generator) -> Raster:
    """Return (SIZE, SIZE, 3) reflectance of one material: two colours in a pattern, and a little grain."""
    patterns = (_plain, _mottled, _checks, _stripes, _dots, _bricks, _veins)
    pattern = patterns[rng.choice(len(patterns), p=[0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1])](rng)
    two = np.stack([color(rng), color(rng)])
    mixed = two[0] * (1 - pattern[..., None]) + two[1] * pattern[..., None]
    grain = 1 + rng.uniform(0, 0.15) * (noise(rng, octaves=6, start=8)[..., None] - 0.5)
    return np.clip(mixed * grain, 0.02, 0.9).astype(np.float32)


def _axes() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    v, u = np.mgrid[:SIZE, :SIZE] / SIZE
    return u, v


def _plain(rng: Generator) -> Raster:
    return np.zeros((SIZE, SIZE), np.float32)


def _mottled(rng: Generator) -> Raster:
    field = noise(rng, start=int(rng.integers(2, 9)))
    return np.clip((field - 0.5) * rng.uniform(1, 4) + 0.5, 0, 1).astype(np.float32)


def _checks(rng: Generator) -> Raster:
    u, v = _axes()
    count = rng.integers(2, 10)
    return ((np.floor(u * count * 2) + np.floor(v * count * 2)) % 2).astype(np.float32)


def _stripes(rng: Generator) -> Raster:
    u, v = _axes()
    phase = (u if rng.uniform() < 0.5 else v) * rng.integers(2, 14) + rng.uniform(0, 0.3) * noise(rng)
    return (phase % 1 < rng.uniform(0.2, 0.8)).astype(np.float32)


def _dots(rng: Generator) -> Raster:
    u, v = _axes()
    count = rng.integers(3, 12)
    away = np.hypot(u * count % 1 - 0.5, v * count % 1 - 0.5)
    return (away < rng.uniform(0.2, 0.45)).astype(np.float32)


def _bricks(rng: Generator) -> Raster:
    u, v = _axes()
    rows = 2 * rng.integers(2, 7)
    row = np.floor(v * rows)
    along = (u * rows / 2 + 0.5 * (row % 2)) % 1
    return ((along < 0.06) | (v * rows % 1 < 0.12)).astype(np.float32)


def _veins(rng: Generator) -> Raster:
    u, _ = _axes()
    wave = np.sin(2 * np.pi * (rng.integers(1, 5) * u + rng.uniform(0.5, 2.5) * noise(rng)))
    return (np.abs(wave) ** rng.uniform(0.3, 2)).astype(np.float32)


def fine_texture(rng: Generator) -> Raster:
    """Return (2 SIZE, 2 SIZE, 3) reflectance with detail down to texels: weave, grain, wood, pebbles,
    print.
    """
    patterns = (_weave, _speckles, _wood, _cells, _print, _fine_stripes)
    pattern = patterns[rng.integers(len(patterns))](rng)
    two = np.stack([color(rng), color(rng)])
    mixed = two[0] * (1 - pattern[..., None]) + two[1] * pattern[..., None]
    return np.clip(mixed, 0.02, 0.9).astype(np.float32)


def relief(rng: Generator) -> Raster:
    """Return (2 SIZE, 2 SIZE) heights of a bumped surface, in 0..1: dents, grain, pebbles, weave or ribs."""
    patterns = (_dents, _grain, _cells, _weave, _ribs)
    return patterns[rng.integers(len(patterns))](rng)


def _fine_axes() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    v, u = np.mgrid[: 2 * SIZE, : 2 * SIZE] / (2 * SIZE)
    return u, v


def _dents(rng: Generator) -> Raster:
    return noise(rng, 2 * SIZE, octaves=2, start=int(rng.integers(6, 20)))


def _grain(rng: Generator) -> Raster:
    return noise(rng, 2 * SIZE, octaves=4, start=int(rng.integers(8, 32)))


def _ribs(rng: Generator) -> Raster:
    u, v = _fine_axes()
    return (0.5 + 0.5 * np.sin(2 * np.pi * rng.integers(8, 40) * (u if rng.uniform() < 0.5 else v))).astype(
        np.float32
    )


def _weave(rng: Generator) -> Raster:
    u, v = _fine_axes()
    count = int(rng.integers(8, 33))
    over = (np.floor(u * 2 * count) + np.floor(v * 2 * count)) % 2
    across, along = np.abs(np.sin(2 * np.pi * count * u)), np.abs(np.sin(2 * np.pi * count * v))
    return np.where(over > 0, across, 0.6 * along).astype(np.float32)


def _speckles(rng: Generator) -> Raster:
    return (noise(rng, 2 * SIZE, octaves=3, start=int(rng.integers(24, 64))) > rng.uniform(0.4, 0.7)).astype(
        np.float32
    )


def _wood(rng: Generator) -> Raster:
    u, v = _fine_axes()
    rings = rng.integers(4, 12) * u + 0.6 * noise(rng, 2 * SIZE, octaves=3, start=2)
    fibres = np.repeat(rng.uniform(size=(1, 2 * SIZE)), 2 * SIZE, axis=0)
    planks = 0.3 * (np.floor(v * rng.integers(1, 6)) % 2)
    return np.clip(0.6 * (rings % 1) + 0.3 * fibres + planks, 0, 1).astype(np.float32)


def _cells(rng: Generator) -> Raster:
    """Return the distance to the nearest of many points, which tile (Worley 1996)."""
    from scipy.spatial import cKDTree

    points = rng.uniform(size=(rng.integers(40, 600), 2))
    near, _ = cKDTree(points, boxsize=1).query(np.stack(_fine_axes(), axis=-1))
    return np.clip(near * np.sqrt(len(points)) * 1.2, 0, 1).astype(np.float32)


def _print(rng: Generator) -> Raster:
    """Return lines of blocks that resemble words on a page."""
    line, size = int(rng.integers(4, 12)), 2 * SIZE
    rows = np.repeat(rng.uniform(size=(size // line + 1, size // 2)) < 0.6, line, axis=0)[:size]
    ink = np.repeat(rows, 2, axis=1)
    return (ink & (np.arange(size) % line < 0.6 * line)[:, None]).astype(np.float32)


def _fine_stripes(rng: Generator) -> Raster:
    u, v = _fine_axes()
    return (((u if rng.uniform() < 0.5 else v) * rng.integers(16, 64)) % 1 < rng.uniform(0.3, 0.7)).astype(
        np.float32
    )
