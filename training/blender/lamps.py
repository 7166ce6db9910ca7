"""Lamps for a view: seven besides the panorama, three of them near surfaces.

Each lights a visible surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.blender.meshes import triple
from dior_rt.training.blender.probe import Hits, Stage
from dior_rt.training.blender.scene import BlenderScene, Camera, Gobo, GoboKind, Lamp, Vector

LAMPS = 7
TRIES = 12
LEAST_LIT = 0.06  # the share of the probe's rays that a lamp must reach
GOBO_SHARE = 0.3


def lamps(scene: BlenderScene, camera: Camera, stage: Stage, hits: Hits, rng: Generator) -> list[Lamp]:
    """Choose the view's lamps.

    There are fewer than LAMPS where no more reach enough of the visible surfaces.
    """
    near: list[Callable[..., Lamp | None]] = [candle, rim, torch]
    far: list[Callable[..., Lamp | None]] = [key, key, window_light, spot, spot, sun, sun, top]
    chosen: list[Lamp] = []
    for k in range(LAMPS):
        makers = near if k < 3 else far
        for _ in range(TRIES):
            lamp = makers[rng.integers(len(makers))](scene, camera, hits, rng)
            if lamp and reaches(lamp, stage, hits) > LEAST_LIT:
                chosen.append(lamp)
                break
    return chosen


def reaches(lamp: Lamp, stage: Stage, hits: Hits) -> float:
    """Return the share of the visible surfaces that a lamp's middle shines on."""
    points, normals = hits.at[hits.hit], hits.normal[hits.hit]
    if lamp.kind == "sun":
        ways, far = np.broadcast_to(-lamp.direction(), points.shape), np.full(len(points), 1e3)
    else:
        away = np.asarray(lamp.at) - points
        far = np.linalg.norm(away, axis=1)
        ways = away / np.maximum(far, 1e-6)[:, None]
    facing = (ways * normals).sum(1) > 0.05
    if lamp.kind == "spot":
        facing &= -(ways @ lamp.direction()) > math.cos(math.radians(lamp.cone / 2))
    if lamp.kind == "area":
        facing &= -(ways @ lamp.direction()) > 0.05
    lit = sum(
        not stage.cast(points[k] + 0.003 * normals[k], ways[k : k + 1], far[k] - 0.01).hit[0]
        for k in np.flatnonzero(facing)
    )
    return lit / len(hits.hit)


def candle(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a small bare light just above a visible surface."""
    point, normal = _seen(scene, hits, rng)
    at = point + normal * scene.span * rng.uniform(0.06, 0.35) + rng.normal(0, 0.03, 3) * scene.span
    return _lamp(scene, "point", at, point, rng.uniform(0.004, 0.03) * scene.span, "candle", rng)


def rim(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a light behind the subject, seen from the camera, that lights its edges."""
    middle = _middle(scene, hits)
    behind = middle - np.asarray(camera.at)
    behind /= np.linalg.norm(behind)
    aside = np.cross(behind, [0, 0, 1.0]) * rng.choice([-1, 1]) * rng.uniform(0.2, 0.9)
    at = middle + scene.span * (behind * rng.uniform(0.35, 0.8) + aside + [0, 0, rng.uniform(0.1, 0.8)])
    kind = "area" if rng.random() < 0.5 else "point"
    return _lamp(scene, kind, at, middle, rng.uniform(0.05, 0.3) * scene.span, "rim", rng)


def torch(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a narrow cone on one place, from nearby."""
    point, normal = _seen(scene, hits, rng)
    way = normal + rng.normal(0, 0.5, 3) + [0, 0, 0.3]
    at = point + way / np.linalg.norm(way) * scene.span * rng.uniform(0.4, 1.0)
    return _lamp(
        scene,
        "spot",
        at,
        point,
        rng.uniform(0.005, 0.03) * scene.span,
        "torch",
        rng,
        cone=rng.uniform(18, 50),
    )


def key(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a photographer's main light: beside the camera, above, hard or soft."""
    middle = _middle(scene, hits)
    at = middle + scene.span * _around(camera, middle, rng, (0.2, 1.9), (0.1, 1.0)) * rng.uniform(0.8, 1.8)
    kind = "area" if rng.random() < 0.5 else "point"
    size = rng.uniform(0.15, 0.9) if kind == "area" else rng.choice([0.01, 0.05, 0.15])
    return _lamp(scene, kind, at, middle, size * scene.span, "key", rng)


def window_light(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a large soft light from one side."""
    middle = _middle(scene, hits)
    at = middle + scene.span * _around(camera, middle, rng, (0.9, 2.2), (-0.1, 0.5)) * rng.uniform(1.0, 1.8)
    return _lamp(scene, "area", at, middle, rng.uniform(0.6, 1.5) * scene.span, "window", rng)


def spot(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a cone on a visible place, from any side."""
    point, normal = _seen(scene, hits, rng)
    way = normal + rng.normal(0, 0.7, 3) + [0, 0, 0.7]
    at = point + way / np.linalg.norm(way) * scene.span * rng.uniform(0.9, 2.0)
    size = rng.choice([0.005, 0.03, 0.1]) * scene.span
    return _lamp(scene, "spot", at, point, size, "spot", rng, cone=rng.uniform(22, 80))


def sun(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return parallel light with hard shadows."""
    middle = _middle(scene, hits)
    way = _around(camera, middle, rng, (0.2, 2.4), (0.15, 1.3))
    return Lamp("sun", triple(middle + 10 * way), triple(middle), float(rng.uniform(0.3, 4)), "sun")


def top(scene: BlenderScene, camera: Camera, hits: Hits, rng: Generator) -> Lamp | None:
    """Return a light above, like a ceiling lamp."""
    middle = _middle(scene, hits)
    at = middle + scene.span * np.array([*rng.normal(0, 0.5, 2), rng.uniform(0.7, 1.6)])
    kind = "point" if rng.random() < 0.5 else "area"
    return _lamp(scene, kind, at, at - [0, 0, 1], rng.uniform(0.03, 0.4) * scene.span, "top", rng)


def _seen(scene: BlenderScene, hits: Hits, rng: Generator) -> tuple[Vector, Vector]:
    """Return a visible point and its normal, on an object more often than on the shell."""
    shell = np.array([thing.role == "shell" for thing in scene.things])[np.maximum(hits.thing, 0)]
    weight = np.where(hits.hit, np.where(shell, 0.3, 1.0), 0)
    index = rng.choice(len(weight), p=weight / weight.sum())
    return hits.at[index], hits.normal[index]


def _middle(scene: BlenderScene, hits: Hits) -> Vector:
    """Return the middle of the visible part of the subject."""
    subject = np.array([thing.role == "subject" for thing in scene.things])[np.maximum(hits.thing, 0)]
    return np.median(hits.at[hits.hit & subject], axis=0)


def _around(
    camera: Camera, middle: Vector, rng: Generator, turn: tuple[float, float], lift: tuple[float, float]
) -> Vector:
    """Return a unit vector from the middle, turned away from the camera's direction to either side, and
    lifted.
    """
    back = np.asarray(camera.at) - middle
    angle = math.atan2(back[1], back[0]) + rng.choice([-1, 1]) * rng.uniform(*turn)
    up = rng.uniform(*lift)
    return np.array([math.cos(angle) * math.cos(up), math.sin(angle) * math.cos(up), math.sin(up)])


def _lamp(
    scene: BlenderScene,
    kind: str,
    at: NDArray[np.floating],
    target: NDArray[np.floating],
    size: float,
    role: str,
    rng: Generator,
    cone: float = 60.0,
) -> Lamp | None:
    """Return the lamp where it has room to stand, sometimes behind a gobo."""
    if not scene.free(np.asarray(at), margin=max(0.02, size if kind == "point" else 0.0)):
        return None
    gobo = (
        _gobo(rng) if kind in ("point", "spot") and role != "candle" and rng.random() < GOBO_SHARE else None
    )
    return Lamp(
        kind,  # type: ignore[arg-type]
        triple(at),
        triple(target),
        float(size if gobo is None else min(size, 0.01)),
        role,
        float(cone),
        float(rng.uniform(0.02, 0.8)),
        gobo,
    )


def _gobo(rng: Generator) -> Gobo:
    kinds: tuple[GoboKind, ...] = ("flag", "flag", "slats", "window", "leaves")
    kind = kinds[rng.integers(5)]
    size = {
        "flag": 1.0,
        "slats": rng.uniform(0.06, 0.25),
        "window": rng.uniform(0.2, 0.5),
        "leaves": rng.uniform(0.1, 0.4),
    }
    soft = rng.uniform(0.02, 0.3)
    return Gobo(kind, float(size[kind]), float(rng.uniform(0, 6.28)), float(rng.normal(0, 0.08)), float(soft))
