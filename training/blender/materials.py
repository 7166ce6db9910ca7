"""Finishes for shells and solids, drawn at random from the surfaces."""

from __future__ import annotations

import colorsys
from dataclasses import replace
from typing import Final

from numpy.random import Generator

from dior_rt.training.blender.assets import Assets, Split
from dior_rt.training.blender.meshes import Finish, Mesh, triple

FLOORS: Final = (
    "WoodFloor", "Planks", "Tiles", "Carpet", "Concrete", "Marble", "Terrazzo", "Tatami", "Granite",
    "Travertine", "Wood", "Fabric", "Cork",
)  # fmt: skip
WALLS: Final = (
    "Wallpaper", "Plaster", "Paint", "Bricks", "Concrete", "WoodSiding", "Tiles", "Planks", "Fabric",
    "Marble", "Paper", "Clay",
)  # fmt: skip
GROUNDS: Final = (
    "Grass", "Ground", "Gravel", "PavingStones", "Asphalt", "Road", "Snow", "Moss", "Rocks",
    "ScatteredLeaves", "Concrete", "Bricks", "WoodChips",
)  # fmt: skip
FACADES: Final = ("Bricks", "Concrete", "WoodSiding", "Plaster", "Planks", "Rock", "PavingStones")
TABLE_TOPS: Final = (
    "Wood",
    "WoodFloor",
    "Marble",
    "Planks",
    "Granite",
    "Fabric",
    "Terrazzo",
    "Plastic",
    "Cork",
    "Paper",
)
METALS: Final = ("Metal", "DiamondPlate", "CorrugatedSteel", "Foil", "Chainmail")
SOFT: Final = (
    "Fabric",
    "Carpet",
    "Grass",
    "Moss",
    "Snow",
    "Paper",
    "Cardboard",
    "Cork",
    "Tatami",
    "ThatchedRoof",
)


def tile(rng: Generator, assets: Assets, split: Split, repeats: float, *kinds: str) -> Finish:
    """Return a surface tile projected at about `repeats` per metre."""
    chosen = assets.surfaces(split, *kinds) or assets.surfaces(split)
    index = chosen[rng.integers(len(chosen))]
    kind = assets.kinds[index]
    metal = kind in METALS
    rough = (
        rng.uniform(0.7, 1) if kind in SOFT else rng.uniform(0.15, 0.5) if metal else rng.uniform(0.2, 0.95)
    )
    tint = rng.uniform(0.75, 1.15) * (1 + rng.normal(0, 0.05, 3))
    return Finish(
        color=triple(tint.clip(0.3, 1.25)),
        texture=assets.tile(index),
        box=float(repeats * rng.uniform(0.7, 1.4)),
        roughness=float(rough),
        metallic=1.0 if metal else 0.0,
        bump=float(rng.uniform(0.05, 0.4)) if rng.random() < 0.3 else 0.0,
    )


def paint(rng: Generator) -> Finish:
    """Return plain paint: mostly near-neutral, sometimes coloured, seldom dark."""
    if rng.random() < 0.65:
        value = rng.uniform(0.3, 0.85) if rng.random() < 0.85 else rng.uniform(0.03, 0.3)
        hue, saturation = (
            rng.uniform(0.02, 0.17) if rng.random() < 0.7 else rng.random(),
            rng.uniform(0, 0.25),
        )
    else:
        hue, saturation, value = rng.random(), rng.uniform(0.25, 0.85), rng.uniform(0.15, 0.8)
    color = colorsys.hsv_to_rgb(hue, saturation, value)
    return Finish(color=color, roughness=float(rng.choice([0.15, 0.35, 0.6, 0.9])))


def metal(rng: Generator) -> Finish:
    """Return polished or brushed metal: steel, brass, copper, black."""
    colors = ((0.6, 0.6, 0.62), (0.8, 0.6, 0.25), (0.75, 0.4, 0.25), (0.85, 0.85, 0.85), (0.1, 0.1, 0.11))
    return Finish(color=colors[rng.integers(5)], metallic=1.0, roughness=float(rng.uniform(0.06, 0.45)))


def glass(rng: Generator) -> Finish:
    """Return clear or lightly coloured glass with a sharp reflection."""
    tint = 1 - rng.uniform(0, 0.3, 3) * (rng.random() < 0.4)
    return Finish(
        color=triple(tint),
        roughness=float(rng.uniform(0.02, 0.12)),
        glass=float(rng.uniform(0.6, 0.92)),
    )


def any_finish(rng: Generator, assets: Assets, split: Split, repeats: float) -> Finish:
    """Return a finish for a solid."""
    pick = rng.random()
    if pick < 0.5:
        return tile(rng, assets, split, repeats)
    return paint(rng) if pick < 0.78 else metal(rng) if pick < 0.89 else glass(rng)


def repainted(rng: Generator, mesh: Mesh) -> Mesh:
    """Return a model, sometimes in other colours and gloss, so that a few models give many."""
    if rng.random() < 0.5:
        return mesh
    tints = 1 + rng.normal(0, 0.12, (len(mesh.finishes), 3))
    gloss = rng.uniform(0.5, 1.4)
    if rng.random() < 0.35:
        hue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.1, 0.6), 1.0)
        tints = tints * hue
    changed = tuple(
        replace(
            finish,
            color=triple((tint * finish.color).clip(0.02, 1.2)),
            roughness=float(min(max(finish.roughness * gloss, 0.05), 1)),
        )
        for finish, tint in zip(mesh.finishes, tints, strict=True)
    )
    return replace(mesh, finishes=changed)
