"""Table tops and products: small objects near the camera, on a table, a sweep or a shelf."""

from __future__ import annotations

import math

import numpy as np

from dior_rt.training.blender import meshes
from dior_rt.training.blender.cameras import around
from dior_rt.training.blender.materials import TABLE_TOPS, WALLS, paint
from dior_rt.training.blender.placing import Floor, Stock, put, radius_of, shell
from dior_rt.training.blender.scene import BlenderScene, Panorama, Thing


def table(stock: Stock, seed: int, panorama: Panorama, views: int) -> BlenderScene:
    """Return one to seven objects on a table. Behind them is a wall, a studio sweep, or the panorama."""
    rng = stock.rng
    things: list[Thing] = []
    _ground(stock, things)
    tray = Floor((-0.8, -0.5), (0.8, 0.6))
    hero = rng.uniform(0.2, 0.5)
    mesh, scale = _hero(stock, hero)
    foot = tray.spot(rng, radius_of(mesh, scale), near=(0, 0)) or (0.0, 0.0)
    subject = put(things, mesh, *foot, turn=rng.uniform(0, 6.28), scale=scale, role="subject")
    for _ in range(int(rng.integers(0, 7))):
        mesh, scale = stock.small(hero * rng.uniform(0.35, 1.1))
        if spot := tray.spot(rng, radius_of(mesh, scale), near=subject.at[:2]):
            put(things, mesh, *spot, turn=rng.uniform(0, 6.28), scale=scale)
    corners = subject.corners()
    cameras = around(
        rng, corners.min(0), corners.max(0), views, -math.pi / 2, 0.6, fill=(0.3, 0.75), lift=(0.05, 0.85)
    )
    return BlenderScene("table", seed, stock.split, tuple(things), panorama, cameras, span=2 * hero)


def _hero(stock: Stock, height: float) -> tuple[meshes.Mesh, float]:
    """Return a product: a small model, a miniature of a large one, or a solid."""
    rng = stock.rng
    pick = rng.random()
    if pick < 0.2:
        return stock.solid(height), 1.0
    if pick < 0.3:
        return stock.vessel(height), 1.0
    places = ("small",) if pick < 0.7 else ("floor", "vehicle", "animal", "outdoor", "wall")
    entry = stock.entry(*places)
    assert entry
    return stock.model(entry), height / max(entry.size)


def _ground(stock: Stock, things: list[Thing]) -> None:
    rng = stock.rng
    pick = rng.random()
    if pick < 0.3:  # a sweep: the table curves up into the background
        radius, far = rng.uniform(0.3, 0.8), rng.uniform(0.7, 1.4)
        turn = np.linspace(0, np.pi / 2, 16)
        y = np.concatenate([[-3, 0], far + radius * np.sin(turn), [far + radius]])
        z = np.concatenate([[0, 0], radius * (1 - np.cos(turn)), [3.0]])
        x = np.array([-4.0, 4.0])[:, None]
        points = np.stack(np.broadcast_arrays(x, y, z), -1)
        mesh = meshes.grid(points).finished(
            paint(rng) if rng.random() < 0.8 else stock.tile(1, "Paper", "Fabric")
        )
        things.append(Thing(mesh, (0, 0, 0), role="shell"))
        return
    size = (rng.uniform(1.2, 2.5), rng.uniform(1.0, 1.6)) if pick < 0.65 else (5.0, 5.0)
    shell(things, (*size, 0.04), (0, 0, -0.04), stock.tile(rng.uniform(0.8, 2.0), *TABLE_TOPS))
    if pick < 0.65:
        shell(things, (9, 9, 0.1), (0, 0, -0.85), stock.tile(0.7))
    if rng.random() < 0.65:
        wall = stock.paint_or_tile(rng.uniform(0.4, 1), *WALLS)
        shell(things, (9, 0.1, 4), (0, rng.uniform(0.75, 2.2), -0.75), wall)
        if rng.random() < 0.3:
            shell(things, (0.1, 9, 4), (rng.choice([-1, 1]) * rng.uniform(1.2, 2), 0, -0.75), wall)
