"""Environment light: procedural panoramas of linear radiance, drawn from a seed, with a mean of 1.

A panorama (H, 2H, 3) is equirectangular as Mitsuba's `envmap` has it: rows from the zenith, y up, to the
nadir, columns once around, from -z over +x to +z in the middle, and back over -x.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.scenes.textures import Raster, noise

ROWS = 64
Rays = NDArray[np.float64]

ZENITH = np.array([0.25, 0.45, 1.0])
HAZE = np.array([0.85, 0.92, 1.0])
DUSK = np.array([1.0, 0.55, 0.25])


def rays(rows: int = ROWS) -> Rays:
    """Return (rows, 2 rows, 3), the unit vectors to a panorama's pixels."""
    down = (np.arange(rows) + 0.5) / rows * np.pi
    around = (np.arange(2 * rows) + 0.5) / rows * np.pi
    theta, phi = np.meshgrid(down, around, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)


def panorama(rng: Generator) -> Raster:
    """Return a clear or clouded sky with the sun, an overcast sky, or a room with windows and lamps."""
    kind = rng.choice(4, p=[0.3, 0.2, 0.15, 0.35])
    if kind == 3:
        light = _room(rng)
    elif kind == 2:
        light = _overcast(rng)
    else:
        light = _sunny(rng, clouds=float(rng.uniform(0.3, 1)) if kind == 1 else 0.0)
    return _exposed(light)


def _exposed(light: Rays) -> Raster:
    """Return the panorama scaled to a mean of 1 over the sphere."""
    weight = np.sqrt(1 - rays(len(light))[..., 1:2] ** 2)
    return (light / ((light * weight).sum() / (3 * weight.sum()))).astype(np.float32)


def _over_ground(rng: Generator, sky: Rays) -> Rays:
    """Return the sky with a ground below the horizon that reflects a part of its light."""
    up = rays()[..., 1:2]
    ground = rng.uniform(0.05, 0.3) * sky[: ROWS // 2].mean(axis=(0, 1)) * rng.uniform(0.8, 1.2, 3)
    return np.where(up > 0, sky, ground)


def _sunny(rng: Generator, clouds: float) -> Rays:
    """Return a sky blue from horizon to zenith, red about a low sun, with the sun as a disc some degrees
    wide.
    """
    towards = rays()
    up = np.clip(towards[..., 1:2], 0, 1)
    height = np.radians(rng.uniform(4, 70))
    # A sun behind the scene's backdrop, at -z, would light nothing.
    around = rng.uniform(-0.65, 0.65) * np.pi
    sun = np.array([np.sin(around) * np.cos(height), np.sin(height), np.cos(around) * np.cos(height)])
    warmth = np.exp(-np.degrees(height) / 12)
    near = np.clip(towards @ sun, -1, 1)[..., None]
    blue = HAZE + (ZENITH - HAZE) * up**0.5
    glow = np.exp(-np.arccos(near) / 0.5) * (1 - up)
    sky = blue * (1 - 0.5 * warmth) + DUSK * (2 * warmth + 0.3) * glow
    if clouds:
        cover = np.clip((_clouds(rng) - 0.5) * 4 + clouds - 0.5, 0, 1)[..., None]
        sky = sky * (1 - cover) + cover * rng.uniform(0.6, 1.6)
    radius = np.radians(rng.uniform(1.5, 7))
    disc = 1 / (1 + np.exp((np.arccos(near) - radius) / 0.02))
    share = rng.uniform(0.5, 4) * (1 - 0.6 * clouds)  # ratio of the sun's light to the sky's
    color = (1 - warmth) * np.array([1.0, 0.95, 0.88]) + warmth * np.array([1.0, 0.6, 0.3])
    solid = np.sqrt(1 - towards[..., 1:2] ** 2)
    strength = share * (sky * solid)[: ROWS // 2].mean(axis=-1).sum() / max(float((disc * solid).sum()), 1e-6)
    return _over_ground(rng, sky + strength * disc * color)


def _overcast(rng: Generator) -> Rays:
    """Return a sky three times as bright at the zenith as at the horizon (Moon and Spencer 1942), in grey
    clouds.
    """
    up = np.clip(rays()[..., 1:2], 0, 1)
    clouds = 1 + rng.uniform(0, 1.2) * (_clouds(rng)[..., None] - 0.5)
    return _over_ground(rng, (1 + 2 * up) / 3 * clouds * (HAZE + rng.uniform(-0.08, 0.08, 3)))


def _clouds(rng: Generator) -> NDArray[np.float64]:
    """Return (ROWS, 2 ROWS) noise on a plane overhead, which turns to haze at the horizon."""
    towards = rays()
    field = noise(rng, 128, octaves=5, start=3)
    plane = towards[..., [0, 2]] / np.maximum(towards[..., 1:2], 0.12) * 0.25
    row, column = np.moveaxis((plane * 128).astype(int) % 128, -1, 0)
    fade = np.clip(towards[..., 1] / 0.2, 0, 1)
    return np.where(towards[..., 1] > 0, 0.5 + fade * (field[row, column] - 0.5), 0.5)


def _room(rng: Generator) -> Rays:
    """Return a dim box about the scene, with windows in its walls and lamps in its ceiling."""
    towards = rays()
    half = rng.uniform([2, 1.2, 2], [4, 2, 4])
    reach = half / np.maximum(np.abs(towards), 1e-9)
    wall = reach.argmin(axis=-1)
    at = towards * reach.min(axis=-1)[..., None]
    shade = rng.uniform(0.2, 1, 3) * rng.uniform(0.6, 1.0)
    light = np.broadcast_to(shade * rng.uniform(0.02, 0.12), towards.shape).copy()
    light[(wall == 1) & (towards[..., 1] < 0)] *= rng.uniform(0.2, 0.8)
    for _ in range(rng.integers(1, 5)):
        light += _opening(rng, half, wall, at)
    return light


def _opening(rng: Generator, half: Rays, wall: NDArray[np.int64], at: Rays) -> Rays:
    """Return the light on the panorama of a window, with or without a cross of bars, or of a lamp in the
    ceiling.
    """
    axis = int(rng.choice([0, 1, 2], p=[0.4, 0.3, 0.3]))
    sign = 1 if axis else rng.choice([-1, 1])  # none behind the backdrop, at -z
    u, v = (k for k in range(3) if k != axis)
    size = rng.uniform(0.15, 0.45, 2) * half[[u, v]]
    middle = rng.uniform(-0.5, 0.5, 2) * half[[u, v]]
    off = np.abs(at[..., [u, v]] - middle)
    inside = (wall == axis) & (at[..., axis] * sign > 0) & (off < size).all(axis=-1)
    if axis != 1 and rng.uniform() < 0.5:
        inside &= (off > 0.12 * size).all(axis=-1)
    warm = rng.normal(0, 0.2)
    color = np.exp([warm, 0, -1.4 * warm]) if axis == 1 else HAZE * np.exp([-abs(warm), 0, abs(warm)])
    return inside[..., None] * color * 2 ** rng.uniform(0, 4)
