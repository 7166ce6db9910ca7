"""Closed surfaces as triangle meshes: superquadrics, lathes, tori, and bumpy variants of them.

Every shape is a map of the unit square, position(u, v), sampled on a lattice; u runs around, v along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.training.scenes.textures import noise

AROUND, ALONG = 64, 48


@dataclass(frozen=True)
class Mesh:
    """vertices (N, 3), texture coordinates (N, 2), triangles (M, 3).

    Shapes are about one unit in radius, at the origin, y up.
    """

    vertices: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.uint32]

    def placed(self, scale: NDArray[np.float64], turn: float, at: NDArray[np.float64]) -> Mesh:
        """Return the mesh scaled per axis, turned by an angle (radians) about y, and moved."""
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        moved = (self.vertices * scale) @ rotation.T + at
        return Mesh(moved.astype(np.float32), self.uv, self.faces)


def lattice(position: NDArray[np.float64]) -> Mesh:
    """Return a mesh of positions (rows, columns, 3), which run around to the right and along downwards."""
    rows, columns = position.shape[:2]
    v, u = np.mgrid[:rows, :columns]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + columns, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + columns, corner + columns + 1], axis=1)
    uv = np.stack([u / (columns - 1), v / (rows - 1)], axis=-1).reshape(-1, 2)
    faces = np.concatenate([lower, upper]).astype(np.uint32)
    vertices = position.reshape(-1, 3)
    return _without_slivers(Mesh(vertices.astype(np.float32), uv.astype(np.float32), faces))


def _without_slivers(mesh: Mesh) -> Mesh:
    """Drop the triangles that collapse at the poles, because they have no normal."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Mesh(mesh.vertices, mesh.uv, mesh.faces[area > 1e-10])


def box(half: NDArray[np.float64]) -> Mesh:
    """Return a cuboid of half sides, centred, with sharp edges and a texture that repeats every 2 units."""
    vertices: list[NDArray[np.float64]] = []
    uv: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign * half[axis]
            corners[:, u] = np.array([-1, 1, 1, -1]) * half[u]
            corners[:, v] = np.array([-1, -1, 1, 1]) * half[v]
            order = np.array([[0, 1, 2], [0, 2, 3]]) if sign > 0 else np.array([[0, 2, 1], [0, 3, 2]])
            faces.append(order + 4 * len(vertices))
            vertices.append(corners)
            uv.append(corners[:, [u, v]] / 2)
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(uv).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
    )


def _angles() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    around = np.linspace(0, 2 * np.pi, AROUND + 1)[None, :]
    along = np.linspace(np.pi / 2, -np.pi / 2, ALONG + 1)[:, None]
    return around, along


def superquadric(roundness_along: float, roundness_around: float) -> Mesh:
    """Return a superquadric (Barr 1981): exponents 1, 1 give a sphere; towards 0 the profile becomes a
    box.
    """
    around, along = _angles()

    def power(x: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
        return np.sign(x) * np.abs(x) ** exponent

    ring = power(np.cos(along), roundness_along)
    x = ring * power(np.cos(around), roundness_around)
    z = -ring * power(np.sin(around), roundness_around)
    y = power(np.sin(along), roundness_along) * np.ones_like(around)
    return lattice(np.stack([x, y, z], axis=-1))


def lathe(rng: Generator) -> Mesh:
    """Return a turned profile: vase, bottle, bowl, pawn."""
    around, along = _angles()
    height = (along[:, 0] + np.pi / 2) / np.pi
    knots = np.concatenate(
        [[rng.uniform(0.4, 1)], rng.uniform(0.2, 1, rng.integers(2, 5)), [rng.uniform(0.2, 0.8)]]
    )
    profile = np.interp(height, np.linspace(0, 1, len(knots)), knots)
    profile = np.convolve(np.pad(profile, 4, mode="edge"), np.ones(9) / 9, mode="valid")
    profile[0] = profile[-1] = 0
    x, z = profile[:, None] * np.cos(around), -profile[:, None] * np.sin(around)
    y = (2 * height - 1)[:, None] * np.ones_like(around)
    return lattice(np.stack([x, y, z], axis=-1))


def torus(thickness: float) -> Mesh:
    """Return a ring that lies flat. thickness: the tube's radius over the ring's, below 1."""
    around, _ = _angles()
    tube = np.linspace(0, 2 * np.pi, ALONG + 1)[:, None]
    ring = (1 + thickness * np.cos(tube)) / (1 + thickness)
    y = thickness * np.sin(-tube) / (1 + thickness) * np.ones_like(around)
    return lattice(np.stack([ring * np.cos(around), y, -ring * np.sin(around)], axis=-1))


def bumpy(mesh: Mesh, rng: Generator, depth: float) -> Mesh:
    """Return the mesh displaced along its radius by smooth noise of that depth. The poles stay closed."""
    field = noise(rng, size=AROUND, octaves=3, start=2)
    column = np.minimum((mesh.uv[:, 0] * AROUND).round().astype(int) % AROUND, AROUND - 1)
    row = np.minimum((mesh.uv[:, 1] * (AROUND - 1)).round().astype(int), AROUND - 1)
    poles = np.sin(np.pi * mesh.uv[:, 1])
    push = 1 + depth * (field[row, column] - 0.5) * poles
    return Mesh((mesh.vertices * push[:, None]).astype(np.float32), mesh.uv, mesh.faces)


def terrain(rng: Generator, half: float, depth: float) -> Mesh:
    """Return uneven ground of that half width around the origin, y up, with heights within the depth."""
    field = np.pad(noise(rng, size=64, octaves=4), ((0, 1), (0, 1)), mode="wrap")
    z, x = np.mgrid[-half:half:65j, -half:half:65j]
    return lattice(np.stack([x, depth * (field - 0.5), z], axis=-1))


def random_shape(rng: Generator) -> Mesh:
    """Return one of the shapes at random. A third of them are bumpy."""
    kind = rng.choice(4, p=[0.2, 0.4, 0.3, 0.1])
    if kind == 0:
        mesh = superquadric(1, 1)
    elif kind == 1:
        mesh = superquadric(rng.uniform(0.08, 1.4), rng.uniform(0.08, 1.4))
    elif kind == 2:
        mesh = lathe(rng)
    else:
        mesh = torus(rng.uniform(0.25, 0.6))
    return bumpy(mesh, rng, rng.uniform(0.15, 0.7)) if rng.uniform() < 0.35 else mesh
