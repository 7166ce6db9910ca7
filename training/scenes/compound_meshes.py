"""Compound meshes: turned, extruded, swept, grown and joined. About one unit in radius, y up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.scenes import shapes
from dior_rt.training.scenes.shapes import Mesh
from dior_rt.training.scenes.textures import noise

Points = NDArray[np.float64]


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(
            np.uint32
        ),
    )


def bar(half: Sequence[float], at: Sequence[float]) -> Mesh:
    """Return a cuboid at a place."""
    return shapes.box(np.array(half)).placed(np.ones(3), 0.0, np.array(at))


def turned(profile: Points, around: int = 40) -> Mesh:
    """Return a profile (K, 2) of radius and height, from the top down, turned about y."""
    angle = np.linspace(0, 2 * np.pi, around + 1)[None, :]
    radius, height = profile[:, :1], profile[:, 1:]
    return shapes.lattice(
        np.stack([radius * np.cos(angle), height + 0 * angle, -radius * np.sin(angle)], axis=-1)
    )


def vessel(rng: Generator) -> Mesh:
    """Return a vase, a jug or a bowl: open above, with a wall of some thickness."""
    from scipy.interpolate import PchipInterpolator

    bowl = rng.uniform() < 0.4
    knots = np.array([0.5, 0.8, 1.0]) if bowl else rng.uniform(0.25, 1, rng.integers(3, 6))
    tall = rng.uniform(0.3, 0.8) if bowl else rng.uniform(0.8, 1.6)
    height = np.linspace(0, 1, 17)
    radius = PchipInterpolator(np.linspace(0, 1, len(knots)), knots)(height)
    outer = np.stack([radius, (2 * height - 1) * tall], axis=1)
    inner = outer * [1, 0.96] - [rng.uniform(0.04, 0.1), 0]
    foot, bottom = [[0.0, -tall]], [[0.0, float(inner[0, 1])]]
    return turned(np.concatenate([bottom, inner, outer[::-1], foot]))


def column(rng: Generator) -> Mesh:
    """Return a pillar two units high, smooth or fluted, on a plinth."""
    flutes = int(rng.choice([0, 0, 12, 20]))
    angle = np.linspace(0, 2 * np.pi, 97)[None, :]
    height = np.linspace(0.9, -0.9, 13)[:, None]
    radius = (0.16 - 0.03 * height) * (1 - 0.06 * np.abs(np.sin(flutes * angle / 2)))
    shaft = shapes.lattice(
        np.stack([radius * np.cos(angle), height + 0 * angle, -radius * np.sin(angle)], axis=-1)
    )
    return joined([shaft, bar([0.25, 0.05, 0.25], [0, -0.95, 0]), bar([0.22, 0.05, 0.22], [0, 0.95, 0])])


def extruded(rng: Generator) -> Mesh:
    """Return an extruded silhouette with sharp edges: a star, a gear, a flower or a blob."""
    angle = np.linspace(0, 2 * np.pi, 97)[:-1]
    teeth, depth = rng.integers(3, 12), rng.uniform(0.1, 0.5)
    kind = rng.integers(4)
    radius: NDArray[np.floating[Any]]
    if kind == 0:  # straight lines between distant and near points
        radius = 1 - depth * np.abs((angle * teeth / np.pi + 1) % 2 - 1)
    elif kind == 1:
        radius = 1 - 0.5 * depth * (np.sin(teeth * angle) > 0)
    elif kind == 2:
        radius = 1 - depth * (1 - np.abs(np.sin(teeth * angle / 2)))
    else:
        waves = rng.normal(0, 0.25, 4) / np.arange(1, 5)
        radius = np.clip(1 + sum(w * np.sin((k + 2) * angle + 6 * w) for k, w in enumerate(waves)), 0.3, 1.6)
    outline = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return standing(prism(outline, rng.uniform(0.08, 0.6)), rng)


def prism(outline: Points, half: float) -> Mesh:
    """Return the outline (K, 2), star-shaped about 0, counter-clockwise in x and y, as a board 2 half thick
    in z.
    """
    ring = np.concatenate([outline, outline[:1]])
    wall = np.stack([np.column_stack([ring, np.full(len(ring), z)]) for z in (half, -half)])
    sides = joined([shapes.lattice(wall[:, k : k + 2]) for k in range(len(outline))])
    caps = []
    for z in (half, -half):
        flat = np.column_stack([np.concatenate([[[0, 0]], outline]), np.full(len(outline) + 1, z)])
        one = np.arange(1, len(outline) + 1)
        other = one % len(outline) + 1
        fan = [0 * one, one, other] if z > 0 else [0 * one, other, one]
        caps.append(
            Mesh(
                flat.astype(np.float32),
                (flat[:, :2] / 2).astype(np.float32),
                np.stack(fan, axis=1).astype(np.uint32),
            )
        )
    return joined([sides, *caps])


def standing(mesh: Mesh, rng: Generator) -> Mesh:
    """Return the mesh upright, or laid flat."""
    if rng.uniform() < 0.6:
        return mesh
    return Mesh(mesh.vertices[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32), mesh.uv, mesh.faces)


def knot(rng: Generator) -> Mesh:
    """Return a tube along a torus knot."""
    p, q = ((2, 3), (3, 2), (2, 5), (1, 3))[rng.integers(4)]
    t = np.linspace(0, 2 * np.pi, 97)
    ring = 0.65 + 0.3 * np.cos(q * t)
    path = np.stack([ring * np.cos(p * t), 0.3 * np.sin(q * t), ring * np.sin(p * t)], axis=1)
    return tube(path, rng.uniform(0.06, 0.16))


def tube(path: Points, radius: float, around: int = 12) -> Mesh:
    """Return a round tube along a path (K, 3) that has no long vertical stretch."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0.05, 1.0, 0.02])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    angle = np.linspace(0, 2 * np.pi, around + 1)[None, :, None]
    return shapes.lattice(
        path[:, None] + radius * (np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None])
    )


def plant(rng: Generator) -> Mesh:
    """Return leaves about a stem."""
    count, wide, bend = rng.integers(8, 30), rng.uniform(0.08, 0.3), rng.uniform(0.1, 0.9)
    stem = rng.uniform(0.0, 1.2)
    leaves = [_leaf(rng, wide, bend) for _ in range(count)]
    turns = rng.uniform(0, 2 * np.pi, count)
    heights = stem * rng.uniform(0, 1, count)
    placed = [
        leaf.placed(np.full(3, rng.uniform(0.5, 1)), turn, np.array([0, height, 0]))
        for leaf, turn, height in zip(leaves, turns, heights, strict=True)
    ]
    trunk = turned(np.array([[0.0, stem], [0.02, stem], [0.04, 0.0], [0.0, 0.0]]), around=8)
    return joined([*placed, trunk])


def _leaf(rng: Generator, wide: float, bend: float) -> Mesh:
    """Return a leaf from the origin along +x, folded along its middle, with a drooping end."""
    t, s = np.meshgrid(np.linspace(0, 1, 11), np.linspace(-1, 1, 5), indexing="ij")
    rise = rng.uniform(0.2, 1.4)
    x = t * np.cos(rise)
    y = t * np.sin(rise) - bend * t**2 + 0.25 * wide * np.abs(s) * np.sin(np.pi * t)
    z = wide * s * np.sin(np.pi * t**0.8)
    return shapes.lattice(np.stack([x, y, z], axis=-1))


def cloth(rng: Generator) -> Mesh:
    """Return a cloth over a round or square table one unit in radius and height, in folds beyond its edge."""
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, 49), np.linspace(-1.5, 1.5, 49), indexing="ij")
    power = 2.0 if rng.uniform() < 0.5 else 8.0
    reach = (np.abs(x) ** power + np.abs(z) ** power) ** (1 / power)
    angle = np.arctan2(z, x)
    beyond = np.clip(reach - 1, 0, None)
    folds = 0.25 * np.sin(rng.integers(6, 14) * angle + rng.uniform(0, 6)) + 0.15 * np.sin(
        rng.integers(15, 25) * angle
    )
    shrink = np.where(reach > 1, (1 + beyond * (0.25 + folds)) / np.maximum(reach, 1e-6), 1.0)
    field = np.pad(noise(rng, 48, octaves=3, start=3), ((0, 1), (0, 1)), mode="wrap") - 0.5
    y = 1 - beyond + 0.03 * field
    return shapes.lattice(np.stack([x * shrink, y, z * shrink], axis=-1).transpose(1, 0, 2)[::-1])


def curtain(rng: Generator) -> Mesh:
    """Return a hanging cloth, two units wide and high, in folds."""
    x, y = np.meshgrid(np.linspace(-1, 1, 129), np.linspace(1, -1, 17))
    phase = rng.integers(4, 12) * np.pi * (x + 0.05 * np.sin(7 * x)) + 0.3 * y
    z = 0.12 * np.sin(phase) * (0.7 - 0.3 * y) + 0.05 * np.sin(2.3 * phase + 1)
    return shapes.lattice(np.stack([x, y, z], axis=-1))


def rock(rng: Generator) -> Mesh:
    """Return a stone: a ball deformed by coarse and fine noise."""
    ball = shapes.superquadric(rng.uniform(0.6, 1.2), rng.uniform(0.6, 1.2))
    return shapes.bumpy(shapes.bumpy(ball, rng, rng.uniform(0.4, 0.9)), rng, rng.uniform(0.2, 0.5))


def table(rng: Generator) -> Mesh:
    """Return a table whose top is at height 1 and reaches to 1 in x."""
    deep, leg = rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.08)
    legs = [
        bar([leg, 0.48, leg], [sx * (1 - leg), 0.48, sz * (deep - leg)]) for sx in (-1, 1) for sz in (-1, 1)
    ]
    return joined([bar([1.0, 0.03, deep], [0, 0.97, 0]), *legs])


def chair(rng: Generator) -> Mesh:
    """Return a chair two units high, with its seat at 0.95 and a back of bars."""
    wide, leg = rng.uniform(0.42, 0.55), rng.uniform(0.03, 0.06)
    parts = [bar([wide, 0.04, wide], [0, 0.92, 0])]
    parts += [
        bar([leg, 0.45, leg], [sx * (wide - leg), 0.45, sz * (wide - leg)])
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    parts += [bar([leg, 0.55, leg], [sx * (wide - leg), 1.45, leg - wide]) for sx in (-1, 1)]
    if rng.uniform() < 0.5:
        heights = np.linspace(1.2, 1.9, rng.integers(2, 5))
        parts += [bar([wide, 0.06, 0.02], [0, height, leg - wide]) for height in heights]
    else:
        places = np.linspace(-wide, wide, rng.integers(4, 8))[1:-1]
        parts += [bar([0.025, 0.5, 0.02], [x, 1.45, leg - wide]) for x in places]
        parts.append(bar([wide, 0.05, 0.03], [0, 1.95, leg - wide]))
    return joined(parts)


def shelf(rng: Generator) -> Mesh:
    """Return a case two units high and wide, open to +z, with boards at the heights of `shelf_heights`."""
    boards = [bar([1.0, 0.025, 0.25], [0, y, 0]) for y in np.linspace(0.03, 1.97, rng.integers(3, 6))]
    sides = [bar([0.025, 1.0, 0.25], [x, 1.0, 0]) for x in (-0.98, 0.98)]
    back = [bar([1.0, 1.0, 0.01], [0, 1.0, -0.24])] if rng.uniform() < 0.6 else []
    return joined([*boards, *sides, *back])


def screen(rng: Generator) -> Mesh:
    """Return bars or blinds, two units wide and high, in the plane z = 0. Light falls through in stripes."""
    count, thick = int(rng.integers(5, 14)), rng.uniform(0.15, 0.55)
    step = 2 / count
    places = -1 + step * (np.arange(count) + 0.5)
    flat = [bar([1.0, thick * step / 2, 0.02], [0, y, 0]) for y in places]
    if rng.uniform() < 0.4:
        return joined([*flat, *(bar([thick * step / 2, 1.0, 0.02], [x, 0, 0]) for x in places)])
    return joined([*flat, bar([0.03, 1.0, 0.03], [-1, 0, 0]), bar([0.03, 1.0, 0.03], [1, 0, 0])])
