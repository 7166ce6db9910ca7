"""Random scenes as plain data, drawn from a seed: objects, cameras, and the sources that light them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.scenes import shapes
from dior_rt.training.scenes.shapes import Mesh
from dior_rt.training.scenes.textures import texture

Vector = NDArray[np.float64]
KINDS = ("subject", "objects", "interior")
SOURCES = 4  # local sources per scene, besides the dome


@dataclass(frozen=True)
class Material:
    """The material of a surface.

    finish: the coating of the reflectance (T, T, 3). roughness: 0 mirror .. 1 matte.

    relief: heights (T, T) of a bumped surface, in units. Their slopes tilt the normals, also those of Lumi
    maps.
    """

    finish: Literal["matte", "plastic", "metal"]
    reflectance: NDArray[np.float32]
    roughness: float
    relief: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Thing:
    mesh: Mesh
    material: Material


@dataclass(frozen=True)
class Source:
    """One light of radiance 1; a spot is a point of intensity 1.

    `target`: the point that panel and spot face.

    size: a sphere's radius; half a square panel's side; a spot's half angle in degrees. A dome shines from
    everywhere and has neither place nor size. The same holds for a sky, whose radiance is its panorama (H,
    2H, 3).
    """

    kind: Literal["sphere", "panel", "spot", "dome", "sky"]
    at: Vector
    target: Vector
    size: float
    panorama: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Camera:
    at: Vector
    target: Vector
    fov: float  # degrees, in both directions: pictures are square

    def sees(self, point: Vector, radius: float) -> bool:
        """Return whether any part of a ball lies inside the viewing pyramid (conservatively, a cone about
        it).
        """
        axis = (self.target - self.at) / np.linalg.norm(self.target - self.at)
        away = point - self.at
        distance = float(np.linalg.norm(away))
        if distance <= radius:
            return True
        half_diagonal = np.arctan(np.sqrt(2) * np.tan(np.radians(self.fov / 2)))
        off_axis = np.arccos(np.clip(away @ axis / distance, -1, 1))
        return bool(off_axis < half_diagonal + np.arcsin(min(1.0, radius / distance)))


@dataclass(frozen=True)
class Scene:
    kind: str
    things: tuple[Thing, ...]
    cameras: tuple[Camera, ...]
    sources: tuple[Source, ...]


def scene(seed: int, cameras: int = 2) -> Scene:
    """Return the scene of a seed, about 4 units across: a single subject, interacting objects, or an
    interior.
    """
    rng = np.random.default_rng(seed)
    kind = KINDS[rng.choice(3, p=[0.25, 0.45, 0.3])]
    builders = {"subject": _subject, "objects": _objects, "interior": _interior}
    things = tuple(builders[kind](rng))
    views = tuple(_camera(rng, kind) for _ in range(cameras))
    return Scene(kind, things, views, tuple(_sources(rng, kind, views)))


def _material(rng: Generator) -> Material:
    finish = ("matte", "plastic", "metal")[rng.choice(3, p=[0.6, 0.3, 0.1])]
    roughness = rng.uniform(0.15, 0.5)
    return Material(finish, texture(rng), float(roughness))  # type: ignore[arg-type]


def _matte(rng: Generator) -> Material:
    return Material("matte", texture(rng), 1.0)


def _slab(size: tuple[float, float, float], at: tuple[float, float, float], material: Material) -> Thing:
    return Thing(shapes.box(np.array(size)).placed(np.ones(3), 0.0, np.array(at)), material)


def _surroundings(rng: Generator) -> list[Thing]:
    """Return ground, and a backdrop on three sides, so that every view ends at a surface."""
    floor = _matte(rng) if rng.uniform() < 0.7 else _material(rng)
    if rng.uniform() < 0.25:
        ground = Thing(shapes.terrain(rng, 7.0, rng.uniform(0.1, 0.6)), floor)
    else:
        ground = _slab((7, 0.1, 7), (0, -0.1, 0), floor)
    wall = _matte(rng)
    distance = rng.uniform(2.5, 6)
    return [
        ground,
        _slab((8, 6, 0.1), (0, 4, -distance), wall),
        _slab((0.1, 6, 8), (-distance - 1, 4, 0), wall),
        _slab((0.1, 6, 8), (distance + 1, 4, 0), wall),
    ]


def _stand(
    mesh: Mesh, scale: Vector, turn: float, x: float, z: float, floor: float, material: Material
) -> Thing:
    """Return the mesh with its lowest point on the floor."""
    placed = mesh.placed(scale, turn, np.array([x, 0.0, z]))
    lowest = float(placed.vertices[:, 1].min())
    return Thing(placed.placed(np.ones(3), 0.0, np.array([0.0, floor - lowest, 0.0])), material)


def _subject(rng: Generator) -> list[Thing]:
    """Return one figure: a body, usually with a head on it."""
    body = _stand(
        shapes.random_shape(rng),
        rng.uniform(0.5, 1.0, 3),
        rng.uniform(0, 6.28),
        0,
        0,
        rng.uniform(-0.1, 0),
        _material(rng),
    )
    things = [*_surroundings(rng), body]
    if rng.uniform() < 0.65:
        top = float(body.mesh.vertices[:, 1].max())
        round_one = shapes.superquadric(rng.uniform(0.8, 1.1), rng.uniform(0.8, 1.1))
        head = shapes.bumpy(round_one, rng, rng.uniform(0.1, 0.5))
        scale = rng.uniform(0.3, 0.6) * np.array([0.85, 1.1, 0.95])
        things.append(_stand(head, scale, rng.uniform(0, 6.28), 0, 0, top - 0.08, _material(rng)))
    return things


def _objects(rng: Generator) -> list[Thing]:
    """Return three to eight objects that shade and touch each other; some stand on others."""
    things = _surroundings(rng)
    for _ in range(rng.integers(3, 9)):
        scale = rng.uniform(0.2, 0.75) * rng.uniform(0.6, 1.5, 3)
        x, z = rng.normal(0, 0.9, 2)
        floor = rng.uniform(0, 1.0) if rng.uniform() < 0.15 else 0.0
        things.append(
            _stand(shapes.random_shape(rng), scale, rng.uniform(0, 6.28), x, z, floor, _material(rng))
        )
    return things


def _interior(rng: Generator) -> list[Thing]:
    """Return a room open towards the camera, with furniture of boxes and objects on it."""
    half, height, back = rng.uniform(1.6, 2.6), rng.uniform(2.2, 3.2), rng.uniform(1.2, 2.5)
    wall, middle = _matte(rng), height / 2
    things = [
        _slab((half + 3, 0.1, back + 5), (0, -0.1, 0), _material(rng)),
        _slab((half + 0.2, middle, 0.1), (0, middle, -back - 0.1), wall),
        _slab(
            (0.1, middle, back + 1.5), (-half - 0.1, middle, 0), wall if rng.uniform() < 0.5 else _matte(rng)
        ),
        _slab((0.1, middle, back + 1.5), (half + 0.1, middle, 0), wall),
    ]
    if rng.uniform() < 0.6:
        things.append(_slab((half + 0.2, 0.1, back + 1.5), (0, height + 0.1, 0), _matte(rng)))
    for _ in range(rng.integers(2, 6)):
        things += _furniture(rng, half, back)
    return things


def _furniture(rng: Generator, half: float, back: float) -> list[Thing]:
    """Return a block, usually with an object on it."""
    size = rng.uniform(0.15, 0.7, 3) * np.array([1, 0.8, 0.8])
    x, z = rng.uniform(-half + size[0], half - size[0]), rng.uniform(-back + size[2], 0.8)
    block = _stand(shapes.box(size), np.ones(3), rng.choice([0.0, 0.0, 0.5]), x, z, 0.0, _material(rng))
    things = [block]
    if rng.uniform() < 0.6:
        scale = rng.uniform(0.12, 0.35) * rng.uniform(0.7, 1.4, 3)
        top = float(block.mesh.vertices[:, 1].max())
        things.append(
            _stand(shapes.random_shape(rng), scale, rng.uniform(0, 6.28), x, z, top, _material(rng))
        )
    return things


def direction(around: float, up: float) -> Vector:
    """Return the unit vector of two angles: around the vertical, from +z towards +x, and up from the
    ground.
    """
    return np.array([np.sin(around) * np.cos(up), np.sin(up), np.cos(around) * np.cos(up)])


def _camera(rng: Generator, kind: str) -> Camera:
    if kind == "interior":
        at = np.array([rng.uniform(-0.8, 0.8), rng.uniform(0.9, 1.9), rng.uniform(3.0, 4.5)])
        return Camera(
            at, np.array([rng.uniform(-0.6, 0.6), rng.uniform(0.5, 1.2), -1.0]), rng.uniform(40, 62)
        )
    around, up, away = rng.uniform(-0.7, 0.7), rng.uniform(0.1, 0.8), rng.uniform(3.2, 5.0)
    target = np.array([rng.normal(0, 0.2), rng.uniform(0.3, 0.9), rng.normal(0, 0.2)])
    return Camera(target + away * direction(around, up), target, rng.uniform(28, 48))


def _sources(rng: Generator, kind: str, cameras: tuple[Camera, ...]) -> list[Source]:
    """Return local sources that no camera sees, and the dome."""
    drawn = (_source(rng, kind) for _ in count())
    return [*islice(unseen(drawn, cameras), SOURCES), Source("dome", np.zeros(3), np.zeros(3), 0.0)]


def unseen(sources: Iterator[Source], cameras: tuple[Camera, ...]) -> Iterator[Source]:
    """Yield the sources that lie outside every camera's view."""
    for source in sources:
        radius = (
            0.0 if source.kind == "spot" else source.size * (np.sqrt(2) if source.kind == "panel" else 1.0)
        )
        if not any(camera.sees(source.at, radius) for camera in cameras):
            yield source


def _source(rng: Generator, kind: str) -> Source:
    form = ("sphere", "panel", "spot")[rng.choice(3, p=[0.45, 0.2, 0.35])]
    size = {"sphere": rng.uniform(0.03, 0.4), "panel": rng.uniform(0.15, 0.8), "spot": rng.uniform(9, 32)}[
        form
    ]
    target = np.array([rng.normal(0, 0.8), rng.uniform(0, 1.2), rng.normal(-0.2, 0.8)])
    if kind == "interior":
        at = np.array([rng.uniform(-1.5, 1.5), rng.uniform(0.3, 2.1), rng.uniform(-1, 4.5)])
    else:
        around, up, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 1.4), rng.uniform(1.2, 5)
        at = target + away * direction(around, up)
        at[1] = max(at[1], 0.5)
        at[2] = max(at[2], -2.2)  # in front of the backdrop
    return Source(form, at, target, float(size))  # type: ignore[arg-type]
