"""Triangle meshes: plain arrays, their materials, and the solids that scenes are made of. Metres, z up."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]
Triple = tuple[float, float, float]


def triple(values: ArrayLike) -> Triple:
    """Return three numbers as plain floats."""
    x, y, z = np.asarray(values, float).tolist()
    return x, y, z


@dataclass(frozen=True)
class Finish:
    """The finish of a surface, which determines how it reflects.

    color: linear RGB, a factor on the texture where there is one. texture: (h, w, 3 or 4) uint8 sRGB, row 0
    on top; a fourth channel cuts out. box: the texture is projected along the axes at `box` repeats per
    metre; 0 uses the mesh's uv. glass: the share of light that passes straight through. bump: strength of a
    relief made from the texture.
    """

    color: tuple[float, float, float] = (0.6, 0.6, 0.6)
    texture: NDArray[np.uint8] | None = field(default=None, compare=False)
    box: float = 0.0
    roughness: float = 0.6
    metallic: float = 0.0
    glass: float = 0.0
    bump: float = 0.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with its finishes.

    vertices: (N, 3). faces: (M, 3) indices. uv: (M, 3, 2) per corner, or None. slots: (M,) index into
    finishes. smooth: the angle in degrees below which neighbouring faces share their shading.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    uv: Floats | None
    slots: NDArray[np.int32]
    finishes: tuple[Finish, ...]
    smooth: float = 40.0

    @property
    def low(self) -> Floats:
        return self.vertices.min(0)

    @property
    def size(self) -> Floats:
        return np.ptp(self.vertices, axis=0)

    def finished(self, finish: Finish) -> Mesh:
        """Return the same shape, all in one finish."""
        return replace(self, slots=np.zeros(len(self.faces), np.int32), finishes=(finish,))


def solid(vertices: object, faces: object, smooth: float = 40.0) -> Mesh:
    """Return a mesh with one grey finish and no uv."""
    corners = np.asarray(faces, np.int32)
    return Mesh(
        np.asarray(vertices, np.float32), corners, None, np.zeros(len(corners), np.int32), (Finish(),), smooth
    )


def box(size: tuple[float, float, float]) -> Mesh:
    """Return a box that stands on the ground, centred on the z axis."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]) * size
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return solid(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def grid(points: NDArray[np.floating], closed: bool = False) -> Mesh:
    """Return a surface through (rows, columns, 3) points. closed: whether the last column joins the first."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return solid(points.reshape(-1, 3), faces)


def lathe(profile: object, sides: int = 40) -> Mesh:
    """Return a solid of revolution about z from (radius, height) pairs, lowest first."""
    r, z = np.asarray(profile, float).T[:, :, None]
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None]
    return grid(np.stack([r * np.cos(turn), r * np.sin(turn), np.broadcast_to(z, (len(z), sides))], -1), True)


def cylinder(radius: float, height: float) -> Mesh:
    """Return a closed cylinder that stands on the ground."""
    return lathe([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)])


def ball(radius: float) -> Mesh:
    """Return a sphere that stands on the ground."""
    angle = np.linspace(0, np.pi, 24)
    return lathe(np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle))], -1))


def tube(path: object, radius: float, sides: int = 10) -> Mesh:
    """Return a round wire along (n, 3) points."""
    at = np.asarray(path, float)
    along = np.gradient(at, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0.31, 0.17, 0.93])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(along, side)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    return grid(at[:, None] + radius * (side[:, None] * np.cos(turn) + up[:, None] * np.sin(turn)), True)


def ring(radius: float, thickness: float) -> Mesh:
    """Return a torus lying on the ground."""
    turn = np.linspace(0, 2 * np.pi, 40)
    path = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, thickness)], -1)
    return tube(path, thickness, 14)


def cloth(width: float, height: float, rng: Generator) -> Mesh:
    """Return a hanging sheet with folds, its lower edge on the ground, facing -y."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 80), np.linspace(0, 1, 12))
    depth = sum(
        rng.uniform(0.1, 0.5) * np.sin(k * 6.28 * u + rng.uniform(0, 6.28) + rng.normal(0, 0.6) * v) / k**0.5
        for k in rng.integers(2, 12, 4)
    )
    return grid(np.stack([u * width, 0.12 * min(width, 1) * depth, v * height], -1))


def rock(radius: float, rng: Generator) -> Mesh:
    """Return a lumpy ball standing on the ground."""
    mesh = ball(radius)
    v = mesh.vertices - [0, 0, radius]
    wave = rng.normal(0, 1.6 / radius, (6, 3))
    lumps = sum(np.sin(v @ w + p) for w, p in zip(wave, rng.uniform(0, 6.28, 6), strict=True))
    v = v * (1 + 0.07 * lumps[:, None]) * rng.uniform(0.7, 1.1, 3)
    return replace(mesh, vertices=(v - [0, 0, v[:, 2].min()]).astype(np.float32))


def vessel(height: float, rng: Generator) -> Mesh:
    """Return a vase, bottle, bowl or cup with a wall: a smooth random profile, up outside and down inside."""
    t = np.linspace(0, 1, 18)
    knots = rng.uniform(0.12, 0.5, 5) * rng.choice([0.7, 1, 1.5])
    outside = np.interp(t, np.linspace(0, 1, 5), knots)
    outside = np.convolve(np.pad(outside, 2, mode="edge"), np.ones(5) / 5, mode="valid") * height
    inside = np.maximum(outside - 0.03 * height, 0.004)
    profile = [(0.0, 0.0), *zip(outside, t * height, strict=True)]
    return lathe([*profile, *zip(inside[:1:-1], t[:1:-1] * height, strict=True), (0.0, 0.06 * height)])


def leaves(height: float, rng: Generator) -> Mesh:
    """Return a plant of thin bent blades."""
    parts = []
    for _ in range(int(rng.integers(8, 40))):
        turn, bend, reach = rng.uniform(0, 6.28), rng.uniform(0.2, 1.0), height * rng.uniform(0.6, 1.1)
        t = np.linspace(0, 1, 7)
        out, up = reach * bend * t**1.7 * 0.7, reach * (t - 0.45 * bend * t**2.5)
        width = reach * rng.uniform(0.02, 0.09) * np.sin(np.pi * np.clip(t, 0.08, 0.98)) ** 0.7
        ahead, aside = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        spine = np.concatenate([out[:, None] * ahead, up[:, None]], 1)
        edge = np.concatenate([width[:, None] * aside, np.zeros((7, 1))], 1)
        parts.append(grid(np.stack([spine - edge, spine + edge], 1)))
    return join(parts)


def join(parts: list[Mesh]) -> Mesh:
    """Return one mesh of several without uv, in the first one's finish."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    return replace(
        solid(np.concatenate([part.vertices for part in parts]), faces, parts[0].smooth),
        finishes=parts[0].finishes,
    )


def moved(mesh: Mesh, by: tuple[float, float, float]) -> Mesh:
    return replace(mesh, vertices=(mesh.vertices + np.asarray(by)).astype(np.float32))
