"""Choose models and solids and place them next to each other without overlap."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator

from dior_rt.training.blender import meshes
from dior_rt.training.blender.assets import Assets, Entry, Split
from dior_rt.training.blender.materials import any_finish, glass, metal, paint, repainted, tile
from dior_rt.training.blender.meshes import Mesh
from dior_rt.training.blender.scene import Role, Thing


@dataclass
class Floor:
    """A rectangle on which objects stand as discs that do not overlap."""

    low: tuple[float, float]
    high: tuple[float, float]
    taken: list[tuple[float, float, float]] = field(default_factory=list)

    def spot(
        self, rng: Generator, radius: float, near: tuple[float, float] | None = None
    ) -> tuple[float, float] | None:
        """Return a free place for a disc, or None after some tries. near: a place to stay close to."""
        low, high = np.array(self.low) + radius, np.array(self.high) - radius
        if np.any(low > high):
            return None
        for _ in range(20):
            at = (
                rng.uniform(low, high)
                if near is None
                else rng.normal(near, 2.2 * radius + 0.15).clip(low, high)
            )
            if all(math.dist(at, (x, y)) > 0.85 * (radius + r) for x, y, r in self.taken):
                self.taken.append((float(at[0]), float(at[1]), radius))
                return float(at[0]), float(at[1])
        return None


@dataclass(frozen=True)
class Stock:
    """The models and solids from which a scene draws its objects."""

    rng: Generator
    assets: Assets
    split: Split

    def entry(self, *places: str) -> Entry | None:
        """Return a model that belongs in one of the places."""
        found = self.assets.models(self.split, *places)
        return found[self.rng.integers(len(found))] if found else None

    def model(self, entry: Entry) -> Mesh:
        """Return the entry's mesh, sometimes in other colours."""
        mesh = self.assets.mesh(entry.file)
        return mesh if entry.place == "person" else repainted(self.rng, mesh)

    def tile(self, repeats: float, *kinds: str) -> meshes.Finish:
        return tile(self.rng, self.assets, self.split, repeats, *kinds)

    def paint_or_tile(self, repeats: float, *kinds: str) -> meshes.Finish:
        return paint(self.rng) if self.rng.random() < 0.5 else self.tile(repeats, *kinds)

    def solid(self, height: float) -> Mesh:
        """Return a solid of about that height, in some finish."""
        rng, h = self.rng, height
        forms = (
            lambda: meshes.ball(h / 2),
            lambda: meshes.box((h * rng.uniform(0.4, 1.3), h * rng.uniform(0.3, 1), h)),
            lambda: meshes.cylinder(h * rng.uniform(0.1, 0.5), h),
            lambda: meshes.ring(h * 0.45, h * rng.uniform(0.06, 0.2)),
            lambda: meshes.rock(h / 2, rng),
            lambda: meshes.vessel(h, rng),
            lambda: meshes.vessel(h, rng),
            lambda: meshes.vessel(h, rng),
            lambda: self.flower(h),
            lambda: self.wire(h),
        )
        mesh = forms[rng.integers(len(forms))]()
        if len(mesh.finishes) > 1 or mesh.finishes[0].color != meshes.Finish().color:
            return mesh
        return mesh.finished(any_finish(rng, self.assets, self.split, 1.2 / h))

    def vessel(self, height: float) -> Mesh:
        """Return glass, metal or glazed ware."""
        rng = self.rng
        finish = (
            glass(rng)
            if rng.random() < 0.45
            else metal(rng)
            if rng.random() < 0.4
            else replace(paint(rng), roughness=0.12)
        )
        return meshes.vessel(height, rng).finished(finish)

    def flower(self, height: float) -> Mesh:
        """Return thin leaves."""
        green = self.rng.uniform(0.6, 1.4)
        color = (
            (0.08 * green, 0.2 * green, 0.05 * green)
            if self.rng.random() < 0.8
            else (0.4, 0.15 * green, 0.12)
        )
        return meshes.leaves(height, self.rng).finished(meshes.Finish(color=color, roughness=0.5))

    def wire(self, height: float) -> Mesh:
        """Return thin bent wire standing up."""
        t = np.linspace(0, 1, 40)
        a, b, turns = self.rng.uniform([0.05, 0.05, 0.3], [0.4, 0.4, 3])
        angle = 6.28 * turns * t
        path = np.stack([a * height * np.cos(angle), b * height * np.sin(angle), height * t], -1)
        return meshes.tube(path, height * self.rng.uniform(0.008, 0.03)).finished(metal(self.rng))

    def small(self, height: float) -> tuple[Mesh, float]:
        """Return a small object and the scale that makes it about `height` tall or wide."""
        entry = self.entry("small") if self.rng.random() < 0.6 else None
        if entry is None:
            return (self.vessel(height) if self.rng.random() < 0.3 else self.solid(height)), 1.0
        return self.model(entry), height / max(entry.size)


def radius_of(mesh: Mesh, scale: float = 1.0) -> float:
    """Return half the diagonal of an object's footprint, reduced a little, because boxes are seldom full."""
    return float(0.43 * scale * np.hypot(*mesh.size[:2]))


def put(
    things: list[Thing],
    mesh: Mesh,
    x: float,
    y: float,
    z: float = 0.0,
    turn: float = 0.0,
    scale: float = 1.0,
    role: Role = "thing",
) -> Thing:
    """Stand a mesh at a place, add it to the objects, and return it."""
    thing = Thing(mesh, (x, y, z), turn, scale, role=role)
    things.append(thing)
    return thing


def shell(
    things: list[Thing],
    size: tuple[float, float, float],
    low: tuple[float, float, float],
    finish: meshes.Finish,
) -> None:
    """Add a box of the shell: ground, wall or ceiling. low: the middle of its lower face."""
    things.append(Thing(meshes.box(size).finished(finish), low, role="shell"))
