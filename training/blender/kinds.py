"""Scenes as functions of a seed and the asset folder."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dior_rt.training.blender.assets import Assets, Split
from dior_rt.training.blender.outdoors import outdoor
from dior_rt.training.blender.placing import Stock
from dior_rt.training.blender.portraits import portrait
from dior_rt.training.blender.rooms import room
from dior_rt.training.blender.scene import BlenderScene, Panorama
from dior_rt.training.blender.tables import table

KINDS: Final = {
    "room": (room, 0.3),
    "table": (table, 0.25),
    "outdoor": (outdoor, 0.2),
    "portrait": (portrait, 0.25),
}
OPEN_AIR: Final = (
    "bridge", "city", "dawn", "esplanade", "forest", "night", "park", "sky", "sunrise", "sunset", "venice",
)  # fmt: skip


def scene(seed: int, assets: Assets, split: Split = "train", views: int = 2) -> BlenderScene:
    """Describe the scene of a seed: the same seed, folder and split give the same scene."""
    rng = np.random.default_rng([seed, split == "bench"])
    names, makers = list(KINDS), [maker for maker, _ in KINDS.values()]
    index = int(rng.choice(len(names), p=[share for _, share in KINDS.values()]))
    around = assets.panoramas(split)
    if names[index] == "outdoor":
        around = [name for name in around if name in OPEN_AIR] or around
    panorama = Panorama(around[rng.integers(len(around))], float(rng.uniform(0, 2 * math.pi)))
    return makers[index](Stock(rng, assets, split), seed, panorama, views)
