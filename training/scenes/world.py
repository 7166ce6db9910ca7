"""Scenes of greater variety, as plain data from a seed: meshes of many kinds, bumped, glossy and metallic
surfaces, fine textures, rooms with objects that block the light, and panoramas for environment light.

The same seed gives another scene here than in `scenes.scene`. Sources are candidates: where there are more
than the renderer needs, it takes the first that light the view.
"""

from __future__ import annotations

from itertools import count, islice
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.scenes import compound_meshes, shapes
from dior_rt.training.scenes.scene import Camera, Material, Scene, Source, Thing, Vector, direction, unseen
from dior_rt.training.scenes.shapes import Mesh
from dior_rt.training.scenes.skies import panorama
from dior_rt.training.scenes.textures import fine_texture, relief, texture

CANDIDATES: Final = 12
METALS: Final = np.array(  # reflectance of gold, copper, iron, aluminium, brass
    [[1.0, 0.77, 0.34], [0.95, 0.64, 0.54], [0.56, 0.57, 0.58], [0.91, 0.92, 0.92], [0.91, 0.78, 0.42]]
)
ONE: Final = np.ones(3)


def world(seed: int, cameras: int = 2) -> Scene:
    """Return the scene of a seed, about 4 units across: a still life, a yard, or a room."""
    rng = np.random.default_rng([seed, 11])
    kind = ("still", "yard", "room")[rng.choice(3, p=[0.35, 0.25, 0.4])]
    builders = {"still": _still, "yard": _yard, "room": _room}
    things = tuple(builders[kind](rng))
    views = tuple(_camera(rng, kind) for _ in range(cameras))
    sources = tuple(islice(unseen((_source(rng, kind) for _ in count()), views), CANDIDATES))
    sky = Source("sky", np.zeros(3), np.zeros(3), 0.0, panorama(rng))
    return Scene(kind, things, views, (*sources, sky))


def _material(rng: Generator, matte: float = 0.4) -> Material:
    """Return a material: matte with that probability, else glossy or metallic; often finely textured or
    bumped.
    """
    bumps = _relief(rng) if rng.uniform() < 0.4 else None
    reflectance = fine_texture(rng) if rng.uniform() < 0.5 else texture(rng)
    if rng.uniform() < matte:
        return Material("matte", reflectance, 1.0, bumps)
    if rng.uniform() < 0.55:
        return Material("plastic", reflectance, float(rng.uniform(0.08, 0.4)), bumps)
    if rng.uniform() < 0.6:
        metal = METALS[rng.integers(len(METALS))] * rng.uniform(0.6, 0.95)
        worn = 1 - rng.uniform(0, 0.6) * reflectance.mean(axis=2, keepdims=True)
        reflectance = np.clip(metal * worn, 0.02, 0.95).astype(np.float32)
    return Material("metal", reflectance, float(rng.uniform(0.12, 0.45)), bumps)


def _relief(rng: Generator) -> NDArray[np.float32]:
    heights = relief(rng)
    slope = np.abs(np.diff(heights, axis=0)).mean() * len(heights)
    return (heights * (rng.uniform(0.1, 0.6) / max(float(slope), 1e-3))).astype(np.float32)


def _paint(rng: Generator) -> Material:
    """Return a paint for walls and similar surfaces: mostly matte."""
    return _material(rng, matte=0.85)


def _leafy(rng: Generator) -> Material:
    green = np.array([rng.uniform(0.05, 0.3), rng.uniform(0.2, 0.5), rng.uniform(0.02, 0.15)])
    spots = 1 - 0.4 * texture(rng).mean(axis=2, keepdims=True)
    return Material(
        "plastic", np.clip(green * spots, 0.02, 0.9).astype(np.float32), float(rng.uniform(0.2, 0.5))
    )


def _bar(half: tuple[float, float, float], at: tuple[float, float, float], material: Material) -> Thing:
    return Thing(compound_meshes.bar(half, at), material)


def _stand(
    rng: Generator, mesh: Mesh, size: float, x: float, z: float, floor: float, paint: Material
) -> Thing:
    """Return the mesh, scaled to about `size`, turned, with its lowest point on the floor."""
    scale = size * (rng.uniform(0.85, 1.15, 3) if rng.uniform() < 0.5 else ONE)
    placed = mesh.placed(scale, rng.uniform(0, 6.28), np.array([x, 0.0, z]))
    low = float(placed.vertices[:, 1].min())
    return Thing(placed.placed(ONE, 0.0, np.array([0.0, floor - low, 0.0])), paint)


def _small(rng: Generator) -> Mesh:
    """Return any object that may stand on a table."""
    kind = rng.choice(5, p=[0.3, 0.2, 0.1, 0.15, 0.25])
    makers = (
        compound_meshes.vessel,
        compound_meshes.extruded,
        compound_meshes.knot,
        compound_meshes.rock,
        shapes.random_shape,
    )
    return makers[kind](rng)


def _potted(rng: Generator, size: float, x: float, z: float, floor: float) -> list[Thing]:
    """Return a plant in a pot."""
    pot = _stand(rng, compound_meshes.vessel(rng), 0.35 * size, x, z, floor, _material(rng))
    top = float(pot.mesh.vertices[:, 1].max())
    return [pot, _stand(rng, compound_meshes.plant(rng), size, x, z, top - 0.1 * size, _leafy(rng))]


def _spread(rng: Generator, count: int, half: tuple[float, float], apart: float) -> list[Vector]:
    """Return up to `count` places within half widths of 0, no two closer than `apart`."""
    places: list[Vector] = []
    for _ in range(20 * count):
        place = rng.uniform([-half[0], -half[1]], half)
        if len(places) < count and all(np.linalg.norm(place - other) >= apart for other in places):
            places.append(place)
    return places


def _backdrop(rng: Generator) -> list[Thing]:
    """Return a bowed wall or a hanging behind the scene, as wide as the cameras see. The sides stay open."""
    distance = rng.uniform(3, 7)
    arc = np.linspace(-1.25, 1.25, 33)
    outline = np.stack([np.sin(arc), -np.cos(arc)], axis=1) * distance
    heights = np.array([7.0, -0.2])[:, None]
    at = np.stack(
        [np.tile(outline[:, 0], (2, 1)), np.tile(heights, 33), np.tile(outline[:, 1], (2, 1))], axis=-1
    )
    return [Thing(shapes.lattice(at), _paint(rng))]


def _still(rng: Generator) -> list[Thing]:
    """Return objects close together on a table top or the ground, often on a cloth, before a backdrop."""
    things = [_bar((6, 0.1, 6), (0, -0.1, 0), _material(rng, 0.6)), *_backdrop(rng)]
    floor = 0.0
    if rng.uniform() < 0.4:
        floor = rng.uniform(0.3, 0.7)
        draped = compound_meshes.cloth(rng).placed(
            np.array([1.3, floor / 1.0, 1.1]), rng.uniform(0, 1.5), np.zeros(3)
        )
        lifted = draped.placed(ONE, 0.0, np.array([0, 0.01, 0]))
        things.append(Thing(lifted, _paint(rng)))
    for x, z in _spread(rng, int(rng.integers(3, 9)), (1.1, 0.9), 0.45):
        size = rng.uniform(0.18, 0.5)
        if rng.uniform() < 0.12:
            things += _potted(rng, 1.6 * size, x, z, floor)
        else:
            things.append(_stand(rng, _small(rng), size, x, z, floor, _material(rng)))
    return things


def _yard(rng: Generator) -> list[Thing]:
    """Return open ground with plants, stones, pillars, a chair, a screen: objects that cast long shadows."""
    ground = shapes.terrain(rng, 7.0, rng.uniform(0.05, 0.5)) if rng.uniform() < 0.6 else None
    flat = compound_meshes.bar((7, 0.1, 7), (0, -0.1, 0))
    things = [Thing(ground or flat, _material(rng, 0.8)), *_backdrop(rng)]
    for x, z in _spread(rng, int(rng.integers(4, 10)), (2.0, 1.8), 0.6):
        what = rng.choice(6)
        if what == 0:
            things += _potted(rng, rng.uniform(0.5, 1.1), x, z, 0.0)
        elif what == 1:
            things.append(
                _stand(rng, compound_meshes.column(rng), rng.uniform(0.5, 1.2), x, z, -0.1, _material(rng))
            )
        elif what == 2:
            things.append(
                _stand(rng, compound_meshes.chair(rng), rng.uniform(0.4, 0.7), x, z, 0.0, _material(rng))
            )
        elif what == 3 and z < 0.5:
            things.append(
                _stand(rng, compound_meshes.screen(rng), rng.uniform(0.5, 0.9), x, z, 0.0, _paint(rng))
            )
        elif what == 4:
            things.append(
                _stand(
                    rng, compound_meshes.rock(rng), rng.uniform(0.3, 0.8), x, z, -0.15, _material(rng, 0.8)
                )
            )
        else:
            things.append(_stand(rng, _small(rng), rng.uniform(0.3, 0.7), x, z, 0.0, _material(rng)))
    return things


def _room(rng: Generator) -> list[Thing]:
    """Return walls with a window on one side, which may have blinds; furniture, shelves, pillars,
    curtains.
    """
    half, height, back = rng.uniform(1.7, 2.6), rng.uniform(2.2, 3.0), rng.uniform(1.4, 2.6)
    deep = back + 4.6
    middle = (4.6 - back) / 2
    paint = _paint(rng)
    things = [
        _bar((half, 0.1, deep / 2), (0, -0.1, middle), _material(rng, 0.5)),
        _bar((half + 0.2, height / 2, 0.1), (0, height / 2, -back - 0.1), _paint(rng)),
        _bar((half + 0.2, 0.1, deep / 2), (0, height + 0.1, middle), paint),
    ]
    side = rng.choice([-1, 1])
    things.append(_bar((0.1, height / 2, deep / 2), (-side * (half + 0.1), height / 2, middle), paint))
    things += _window_wall(rng, side * (half + 0.1), height, back, paint)
    if rng.uniform() < 0.3:  # a wall behind the cameras; else the room is open there
        things.append(_bar((half + 0.2, height / 2, 0.1), (0, height / 2, 4.8), paint))
    for x, z in _spread(rng, int(rng.integers(2, 6)), (half - 0.5, back - 0.5), 0.9):
        things += _furniture(rng, x, z)
    if rng.uniform() < 0.4:
        hung = compound_meshes.curtain(rng).placed(np.array([0.5, height / 2, 0.5]), 0.0, np.zeros(3))
        at = np.array([rng.uniform(-half + 0.5, half - 0.5), height / 2, -back + 0.15])
        things.append(Thing(hung.placed(ONE, 0.0, at), _paint(rng)))
    if rng.uniform() < 0.25:
        things.append(
            _stand(
                rng, compound_meshes.column(rng), height / 2, rng.choice([-1, 1]) * half * 0.6, 0.6, 0, paint
            )
        )
    return things


def _window_wall(rng: Generator, x: float, height: float, back: float, paint: Material) -> list[Thing]:
    """Return the wall at x, with a hole, and the objects that hang in it."""
    low, high = rng.uniform(0.1, 0.9), height - rng.uniform(0.1, 0.5)
    near, far = rng.uniform(1.2, 3.0), rng.uniform(-back + 0.2, -0.2)
    pieces = [
        ((low / 2), (low / 2), 4.6, -back),
        ((height - high) / 2, (height + high) / 2, 4.6, -back),
        ((high - low) / 2, (high + low) / 2, far, -back),
        ((high - low) / 2, (high + low) / 2, 4.6, near),
    ]
    things = [_bar((0.1, half, (z1 - z0) / 2), (x, y, (z0 + z1) / 2), paint) for half, y, z1, z0 in pieces]
    if rng.uniform() < 0.5:
        blinds = compound_meshes.screen(rng).placed(
            np.array([(near - far) / 2, (high - low) / 2, 1.0]),
            np.pi / 2,
            np.array([x, (high + low) / 2, (near + far) / 2]),
        )
        things.append(Thing(blinds, _paint(rng)))
    return things


def _furniture(rng: Generator, x: float, z: float) -> list[Thing]:
    """Return a table, a chair, a shelf, a block or a plant; often with small objects on top."""
    what = rng.choice(5, p=[0.3, 0.2, 0.15, 0.2, 0.15])
    if what == 4:
        return _potted(rng, rng.uniform(0.5, 0.9), x, z, 0.0)
    makers = (
        compound_meshes.table,
        compound_meshes.chair,
        compound_meshes.shelf,
        lambda rng: shapes.box(rng.uniform(0.5, 1.0, 3)),
    )
    size = rng.uniform(0.45, 0.75)
    piece = _stand(rng, makers[what](rng), size, x, z, 0.0, _material(rng))
    things = [piece]
    if what in (0, 2, 3):
        top = float(piece.mesh.vertices[:, 1].max())
        for dx, dz in _spread(rng, int(rng.integers(1, 4)), (0.4 * size, 0.15 * size), 0.25):
            things.append(
                _stand(rng, _small(rng), rng.uniform(0.1, 0.22), x + dx, z + dz, top, _material(rng))
            )
    return things


def _camera(rng: Generator, kind: str) -> Camera:
    if kind == "room":
        at = np.array([rng.uniform(-0.9, 0.9), rng.uniform(0.9, 1.8), rng.uniform(2.6, 4.4)])
        return Camera(
            at, np.array([rng.uniform(-0.7, 0.7), rng.uniform(0.5, 1.1), -0.8]), rng.uniform(38, 62)
        )
    around, up = rng.uniform(-0.6, 0.6), rng.uniform(0.12, 0.75)
    away = rng.uniform(2.4, 4.2) if kind == "still" else rng.uniform(3.6, 5.5)
    target = np.array([rng.normal(0, 0.2), rng.uniform(0.2, 0.7), rng.normal(0, 0.2)])
    return Camera(target + away * direction(around, up), target, rng.uniform(28, 46))


def _source(rng: Generator, kind: str) -> Source:
    """Return a lamp, a panel that may be large, or a spot, at a random place about the scene."""
    form = ("sphere", "panel", "spot")[rng.choice(3, p=[0.35, 0.35, 0.3])]
    size = {
        "sphere": 0.03 * 15 ** rng.uniform(),
        "panel": 0.2 * 8 ** rng.uniform(),
        "spot": rng.uniform(10, 35),
    }
    target = np.array([rng.normal(0, 0.7), rng.uniform(0, 0.9), rng.normal(-0.1, 0.7)])
    if kind == "room":
        at = np.array([rng.uniform(-3.4, 3.4), rng.uniform(0.3, 2.1), rng.uniform(-1.2, 4.5)])
    else:
        around, up, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 1.4), rng.uniform(1.5, 5.5)
        at = target + away * direction(around, up)
        at[1], at[2] = max(at[1], 0.4), max(at[2], -2.2)
    return Source(form, at, target, float(size[form]))  # type: ignore[arg-type]
