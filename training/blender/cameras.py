"""Candidate cameras, placed as people hold them: the subject fills a large part of the frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from dior_rt.training.blender.meshes import triple
from dior_rt.training.blender.scene import Camera, Vector

CANDIDATES = 10  # per requested view


def around(
    rng: Generator,
    low: Vector,
    high: Vector,
    views: int,
    facing: float,
    spread: float,
    room: tuple[Vector, Vector] | None = None,
    fill: tuple[float, float] = (0.35, 0.85),
    lift: tuple[float, float] = (0.0, 0.6),
    wide: tuple[float, float] = (28, 62),
) -> tuple[Camera, ...]:
    """Return cameras about a box from `low` to `high`.

    facing, spread: mean and deviation of the direction from the subject to the camera, an angle about z.
    room: corners that the cameras stay within. fill: range of the frame's share that the subject fills. lift:
    range of the elevation, radians. wide: range of the field of view, degrees.
    """
    middle, size = (low + high) / 2, high - low
    extent = max(float(np.hypot(size[0], size[1])) * 0.8, float(size[2]), 0.15)
    return tuple(
        _one(
            rng,
            middle,
            extent,
            rng.normal(facing, spread),
            rng.uniform(*fill),
            rng.uniform(*lift),
            rng.uniform(*wide),
            room,
        )
        for _ in range(CANDIDATES * views)
    )


def _one(
    rng: Generator,
    middle: Vector,
    extent: float,
    angle: float,
    fill: float,
    lift: float,
    fov: float,
    room: tuple[Vector, Vector] | None,
) -> Camera:
    distance = extent / fill / (2 * math.tan(math.radians(fov / 2))) + extent * 0.3
    flat = distance * math.cos(lift)
    away = np.array([flat * math.cos(angle), flat * math.sin(angle), distance * math.sin(lift)])
    at = middle + away
    at[2] = max(at[2], 0.08)
    if room:
        at = at.clip(room[0] + 0.25, room[1] - 0.25)
    frame = 2 * float(np.linalg.norm(at - middle)) * math.tan(math.radians(fov / 2))
    slack = max(frame - extent, 0.2 * frame) / 2  # the largest shift of the subject in the frame
    target = middle + rng.normal(0, 0.4, 3) * slack * [1, 1, 0.7]
    if np.linalg.norm(at[:2] - target[:2]) < 1e-3:
        target[0] += 0.01
    return Camera(triple(at), triple(target), float(fov), float(rng.normal(0, 1.5)))
