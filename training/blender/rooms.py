"""Furnished rooms, with windows in some walls and objects on the furniture."""

from __future__ import annotations

import math

import numpy as np

from dior_rt.training.blender import meshes
from dior_rt.training.blender.cameras import around
from dior_rt.training.blender.materials import FLOORS, WALLS, paint
from dior_rt.training.blender.placing import Floor, Stock, put, radius_of, shell
from dior_rt.training.blender.scene import BlenderScene, Panorama, Thing

WALL = 0.1


def room(stock: Stock, seed: int, panorama: Panorama, views: int) -> BlenderScene:
    """Return a furnished room open towards the camera, with one piece as the subject."""
    rng = stock.rng
    width, depth, height = rng.uniform(3, 5.5), rng.uniform(3, 5), rng.uniform(2.4, 3.1)
    things: list[Thing] = []
    _walls(stock, things, width, depth, height)
    floor = Floor((-width / 2, -depth / 2), (width / 2, depth / 2))
    subject = _subject(stock, things, floor)
    for _ in range(int(rng.integers(2, 7))):
        _furniture(stock, things, floor, width, depth)
    _on_walls(stock, things, width, depth, height)
    for _ in range(int(rng.integers(0, 4))):
        tall = rng.uniform(0.15, 0.6)
        mesh, scale = stock.small(tall)
        if spot := floor.spot(rng, radius_of(mesh, scale)):
            put(things, mesh, *spot, turn=rng.uniform(0, 6.28), scale=scale)
    low, high = subject.corners().min(0), subject.corners().max(0)
    room_low, room_high = (
        np.array([-width / 2, -depth / 2 - 3.0, 0.0]),
        np.array([width / 2, depth / 2, height]),
    )
    cameras = around(rng, low, high, views, facing=-math.pi / 2, spread=0.9, room=(room_low, room_high))
    span = float(np.clip(np.max(high - low) * 1.6, 0.8, 2.5))
    return BlenderScene(
        "room", seed, stock.split, tuple(things), panorama, cameras, span, inside=(room_low, room_high)
    )


def _walls(stock: Stock, things: list[Thing], width: float, depth: float, height: float) -> None:
    rng = stock.rng
    wall = stock.paint_or_tile(rng.uniform(0.4, 1), *WALLS)
    aside = wall if rng.random() < 0.7 else paint(rng)
    long, middle = depth + 6, -3.0
    shell(things, (width + 6, depth + 8, WALL), (0, 0, -WALL), stock.tile(rng.uniform(0.4, 1), *FLOORS))
    window = rng.random()
    back = depth / 2 + WALL / 2
    if window < 0.45:
        pierced(things, width, height, (0, back), 0.0, wall, rng)
    else:
        shell(things, (width, WALL, height), (0, back, 0), wall)
    for sign in (-1, 1):
        x = sign * (width / 2 + WALL / 2)
        if rng.random() < 0.3:
            pierced(things, long, height, (x, middle), math.pi / 2, aside, rng, near=long / 2 - depth / 2)
        else:
            shell(things, (WALL, long, height), (x, middle, 0), aside)
    if rng.random() < 0.8:
        shell(things, (width + 0.2, long + 0.2, WALL), (0, middle, height), paint(rng))


def pierced(
    things: list[Thing],
    length: float,
    height: float,
    at: tuple[float, float],
    turn: float,
    finish: meshes.Finish,
    rng: np.random.Generator,
    near: float = 0.0,
) -> None:
    """Add a wall with a window: four boxes around the hole, a frame with bars, sometimes a curtain."""
    wide, tall = min(rng.uniform(0.8, 2.2), length * 0.6), rng.uniform(0.9, 1.7)
    sill = rng.uniform(0.2, max(0.25, height - tall - 0.3))
    reach = max(length / 2 - wide / 2 - 0.3, 0)
    middle = float(np.clip(near + rng.uniform(-0.8, 0.8), -reach, reach))
    c, s = math.cos(turn), math.sin(turn)

    def part(
        size: tuple[float, float, float], along: float, z: float, look: meshes.Finish, depth: float = 0.0
    ) -> None:
        place = (at[0] + c * along - s * depth, at[1] + s * along + c * depth, z)
        things.append(Thing(meshes.box(size).finished(look), place, turn, role="shell"))

    left, right = middle - wide / 2 + length / 2, length / 2 - middle - wide / 2
    part((left, WALL, height), -length / 2 + left / 2, 0, finish)
    part((right, WALL, height), length / 2 - right / 2, 0, finish)
    part((wide, WALL, sill), middle, 0, finish)
    part((wide, WALL, height - sill - tall), middle, sill + tall, finish)
    frame = paint(rng)
    bars = int(rng.integers(1, 4))
    for k in range(bars + 1):
        part((0.04, 0.05, tall), middle - wide / 2 + wide * k / bars, sill, frame)
    for k in range(int(rng.integers(2, 4))):
        part((wide, 0.05, 0.04), middle, sill + tall * k / 2 - 0.02, frame)


def _subject(stock: Stock, things: list[Thing], floor: Floor) -> Thing:
    rng = stock.rng
    entry = stock.entry("person") if rng.random() < 0.2 else stock.entry("floor", "animal")
    assert entry
    mesh = stock.model(entry)
    scale = min(1.0, 2.2 / max(entry.size))
    spot = floor.spot(rng, radius_of(mesh, scale), near=(0, 0.2)) or (0.0, 0.0)
    thing = put(things, mesh, *spot, turn=rng.normal(0, 0.7), scale=scale, role="subject")
    if entry.place == "floor":
        _on_top(stock, things, thing, entry.top * scale)
    return thing


def _furniture(stock: Stock, things: list[Thing], floor: Floor, width: float, depth: float) -> None:
    rng = stock.rng
    entry = stock.entry("floor") if rng.random() < 0.9 else stock.entry("outdoor", "animal", "person")
    if entry is None or max(entry.size) > 2.6:
        return
    mesh = stock.model(entry)
    radius = radius_of(mesh)
    if rng.random() < 0.55:  # with its back to a wall
        side = int(rng.integers(3))
        gap = entry.size[1] / 2 + 0.04
        turn = (0.0, math.pi / 2, -math.pi / 2)[side]
        along = rng.uniform(-0.4, 0.4)
        at = (
            (along * width, depth / 2 - gap),
            (-width / 2 + gap, along * depth),
            (width / 2 - gap, along * depth),
        )[side]
        if any(math.dist(at, (x, y)) < 0.85 * (radius + r) for x, y, r in floor.taken):
            return
        floor.taken.append((*at, radius))
        spot: tuple[float, float] | None = at
    else:
        spot, turn = floor.spot(rng, radius), rng.uniform(0, 6.28)
    if spot:
        thing = put(things, mesh, *spot, turn=turn)
        _on_top(stock, things, thing, entry.top)


def _on_top(stock: Stock, things: list[Thing], thing: Thing, top: float) -> None:
    """Stand up to three small objects on a piece of furniture."""
    rng = stock.rng
    if not 0.25 < top < 1.3 or rng.random() < 0.3:
        return
    half = thing.mesh.size[:2] * thing.scale / 2
    c, s = math.cos(thing.turn), math.sin(thing.turn)
    tray = Floor(tuple(-0.8 * half), tuple(0.8 * half))
    for _ in range(int(rng.integers(1, 4))):
        mesh, scale = stock.small(rng.uniform(0.1, 0.35))
        if spot := tray.spot(rng, radius_of(mesh, scale)):
            x, y = spot
            place = thing.at[0] + c * x - s * y, thing.at[1] + s * x + c * y, thing.at[2] + top
            put(things, mesh, *place, turn=rng.uniform(0, 6.28), scale=scale)


def _on_walls(stock: Stock, things: list[Thing], width: float, depth: float, height: float) -> None:
    """Hang pictures on the back wall, and sometimes a curtain before it."""
    rng = stock.rng
    y = depth / 2 - 0.02
    for _ in range(int(rng.integers(0, 3))):
        w, h = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.9)
        x, z = rng.uniform(-width / 2 + 0.7, width / 2 - 0.7), rng.uniform(0.9, max(1.0, height - h - 0.3))
        put(things, meshes.box((w, 0.03, h)).finished(stock.tile(1 / max(w, h))), x, y, z)
    if rng.random() < 0.25:
        mesh = meshes.cloth(rng.uniform(0.5, 1.4), height - 0.1, rng).finished(
            stock.paint_or_tile(1.5, "Fabric")
        )
        put(things, mesh, rng.uniform(-width / 3, width / 3), y - 0.12, 0.02)
