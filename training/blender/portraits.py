"""Portraits, half and full figures, alone or with another person, before a wall, a cloth or the panorama."""

from __future__ import annotations

import math
from typing import Final

from dior_rt.training.blender import meshes
from dior_rt.training.blender.assets import Entry
from dior_rt.training.blender.cameras import around
from dior_rt.training.blender.materials import FACADES, FLOORS, GROUNDS, WALLS, paint
from dior_rt.training.blender.placing import Floor, Stock, put, radius_of, shell
from dior_rt.training.blender.scene import BlenderScene, Panorama, Thing

SEAT: Final = 0.45


def portrait(stock: Stock, seed: int, panorama: Panorama, views: int) -> BlenderScene:
    """Return a scene with a person, framed from the head alone to the whole figure."""
    rng = stock.rng
    things: list[Thing] = []
    outside = rng.random() < 0.35
    _backdrop(stock, things, outside)
    subject = _person(stock, things, 0.0, 0.0, turn=rng.normal(0, 0.35), main=True)
    floor = Floor((-3, -1.2), (3, 1.2), [(0.0, 0.0, 0.45)])
    if rng.random() < 0.3:
        side = rng.choice([-1, 1])
        _person(
            stock, things, side * rng.uniform(0.5, 0.9), rng.uniform(-0.1, 0.8), rng.normal(-0.3 * side, 0.4)
        )
        floor.taken.append((things[-1].at[0], things[-1].at[1], 0.45))
    for _ in range(int(rng.integers(0, 4))):
        entry = stock.entry("outdoor" if outside else "floor")
        if entry and max(entry.size) < 2.2:
            mesh = stock.model(entry)
            if spot := floor.spot(rng, radius_of(mesh)):
                put(things, mesh, spot[0], spot[1] + 0.6, turn=rng.uniform(0, 6.28))
    low, high = subject.corners().min(0), subject.corners().max(0)
    # The lowest part of the figure in the picture: the head, the half figure, all of it.
    reach = float(
        rng.choice([0.28, 0.4, 0.55, 0.8, 1.0], p=[0.2, 0.25, 0.25, 0.15, 0.15]) * (high[2] - low[2])
    )
    low[2] = high[2] - reach
    middle = (low[:2] + high[:2]) / 2
    half = min(0.5 * reach, 0.35)
    low[:2], high[:2] = middle - half, middle + half
    cameras = around(
        rng, low, high, views, -math.pi / 2, 0.45, fill=(0.6, 0.95), lift=(-0.12, 0.25), wide=(22, 48)
    )
    return BlenderScene(
        "portrait", seed, stock.split, tuple(things), panorama, cameras, span=max(1.3 * reach, 0.5)
    )


def _person(stock: Stock, things: list[Thing], x: float, y: float, turn: float, main: bool = False) -> Thing:
    """Stand a person, or seat one on a box or barrel."""
    entry = stock.entry("person")
    assert entry
    seated = _sits(entry)
    z = 0.0
    if seated:
        z = stock.rng.uniform(0.0, 0.06)
        seat = meshes.box((0.42, 0.4, SEAT * entry.size[2] / 1.3))
        # The seat is under the hips, which lie behind the middle of a sitting figure.
        back = entry.size[1] / 2 - 0.28
        put(
            things,
            seat.finished(stock.tile(2.0)),
            x - back * math.sin(turn),
            y + back * math.cos(turn),
            turn=turn,
        )
    return put(things, stock.model(entry), x, y, z, turn, role="subject" if main else "thing")


def _sits(entry: Entry) -> bool:
    return entry.file.startswith("people/") and "sitting" in entry.name


def _backdrop(stock: Stock, things: list[Thing], outside: bool) -> None:
    rng = stock.rng
    ground = stock.tile(rng.uniform(0.5, 1), *(GROUNDS if outside else FLOORS))
    shell(things, (60, 60, 0.1), (0, 0, -0.1), ground)
    far = rng.uniform(0.7, 3.0)
    pick = rng.random()
    if outside:
        if pick < 0.4:
            shell(
                things,
                (rng.uniform(3, 9), 0.3, rng.uniform(1, 5)),
                (rng.uniform(-2, 2), far + 1, 0),
                stock.tile(0.5, *FACADES),
            )
        return
    if pick < 0.5:
        shell(things, (9, 0.1, 3.5), (0, far, 0), stock.paint_or_tile(rng.uniform(0.4, 1), *WALLS))
        if rng.random() < 0.4:
            w, h = rng.uniform(0.4, 1.2), rng.uniform(0.4, 1.2)
            put(
                things,
                meshes.box((w, 0.03, h)).finished(stock.tile(1 / max(w, h))),
                rng.uniform(-1, 1),
                far - 0.08,
                1.0,
            )
    elif pick < 0.75:
        mesh = meshes.cloth(5, 3.2, rng).finished(
            paint(rng) if rng.random() < 0.6 else stock.tile(1.2, "Fabric")
        )
        put(things, mesh, 0, far + 0.2, 0.0, role="shell")
    if rng.random() < 0.3:
        side = rng.choice([-1, 1])
        shell(things, (0.1, 6, 3.2), (side * rng.uniform(1.2, 2.2), 0, 0), paint(rng))
