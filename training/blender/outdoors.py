"""Streets and gardens: objects outdoors under a visible sky."""

from __future__ import annotations

import math

import numpy as np

from dior_rt.training.blender import meshes
from dior_rt.training.blender.cameras import around
from dior_rt.training.blender.materials import FACADES, GROUNDS, metal, paint
from dior_rt.training.blender.placing import Floor, Stock, put, radius_of, shell
from dior_rt.training.blender.scene import BlenderScene, Panorama, Thing


def outdoor(stock: Stock, seed: int, panorama: Panorama, views: int) -> BlenderScene:
    """Return a subject on open ground with others around it, sometimes with houses, a fence or a wall
    behind.
    """
    rng = stock.rng
    things: list[Thing] = []
    shell(things, (120, 120, 0.1), (0, 0, -0.1), stock.tile(rng.uniform(0.3, 1), *GROUNDS))
    ground = Floor((-6, -5), (6, 9))
    subject = _subject(stock, things, ground)
    extent = float(np.max(subject.mesh.size) * subject.scale)
    near = subject.at[:2]
    for _ in range(int(rng.integers(1, 7))):
        entry = (
            stock.entry("outdoor", "animal", "person", "vehicle")
            if rng.random() < 0.75
            else stock.entry("floor")
        )
        if entry is None:
            continue
        mesh = stock.model(entry)
        scale = min(1.0, 3 * extent / max(entry.size), 6 / max(entry.size))
        if spot := ground.spot(rng, radius_of(mesh, scale), near=near if rng.random() < 0.6 else None):
            put(things, mesh, *spot, turn=rng.uniform(0, 6.28), scale=scale)
    for _ in range(int(rng.integers(0, 4))):
        tall = extent * rng.uniform(0.1, 0.5)
        mesh = stock.solid(tall)
        if spot := ground.spot(rng, radius_of(mesh), near=near):
            put(things, mesh, *spot, turn=rng.uniform(0, 6.28))
    if rng.random() < 0.6:
        _houses(stock, things)
    if rng.random() < 0.35:
        _fence(stock, things, subject)
    corners = subject.corners()
    cameras = around(rng, corners.min(0), corners.max(0), views, -math.pi / 2, 0.7, lift=(-0.05, 0.35))
    span = float(np.clip(1.5 * extent, 0.6, 4))
    return BlenderScene("outdoor", seed, stock.split, tuple(things), panorama, cameras, span)


def _subject(stock: Stock, things: list[Thing], ground: Floor) -> Thing:
    rng = stock.rng
    entry = stock.entry(*((("outdoor",), ("vehicle",), ("person", "animal"), ("floor",))[rng.integers(4)]))
    assert entry
    mesh = stock.model(entry)
    scale = min(1.0, 4 / max(entry.size))
    spot = ground.spot(rng, radius_of(mesh, scale), near=(0, 0)) or (0.0, 0.0)
    return put(things, mesh, *spot, turn=rng.uniform(0, 6.28), scale=scale, role="subject")


def _houses(stock: Stock, things: list[Thing]) -> None:
    """Add plain houses with windows of dark gloss, some metres behind."""
    rng = stock.rng
    for _ in range(int(rng.integers(1, 4))):
        w, d, h = rng.uniform(3, 9), rng.uniform(2, 6), rng.uniform(2.5, 9)
        x, y = rng.uniform(-9, 9), rng.uniform(6, 16) + d / 2
        shell(things, (w, d, h), (x, y, 0), stock.paint_or_tile(rng.uniform(0.3, 0.8), *FACADES))
        pane = meshes.Finish(color=(0.03, 0.035, 0.04), roughness=0.06)
        across, up = int(w / 1.6), int(h / 2.4)
        for i in range(across):
            for j in range(up):
                at = x + (i - (across - 1) / 2) * w / across, y - d / 2 - 0.01, 0.9 + j * 2.4
                shell(things, (0.9, 0.06, 1.2), at, pane)


def _fence(stock: Stock, things: list[Thing], subject: Thing) -> None:
    """Add a row of thin posts with two rails, behind or beside the subject."""
    rng = stock.rng
    finish = metal(rng) if rng.random() < 0.4 else paint(rng)
    step, tall, wide = rng.uniform(0.12, 0.5), rng.uniform(0.6, 1.6), rng.uniform(0.015, 0.08)
    back = subject.at[1] + rng.uniform(0.5, 2.5) + float(subject.mesh.size.max()) * subject.scale * 0.5
    posts = [meshes.moved(meshes.box((wide, wide, tall)), (x, 0, 0)) for x in np.arange(-5, 5, step)]
    rails = [meshes.moved(meshes.box((10, wide * 0.6, wide)), (0, 0, tall * share)) for share in (0.25, 0.85)]
    put(things, meshes.join([*posts, *rails]).finished(finish), subject.at[0], back)
