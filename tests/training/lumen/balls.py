"""A synthetic view in closed form."""

from __future__ import annotations

import numpy as np

from dior_rt.training.lumen.pack import Rendered

SIDE = 64


def ball(seed: int) -> Rendered:
    """A ball before a wall under three white lamps and an environment, in closed form."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((SIDE, SIDE)) + 0.5
    x, y = (columns / SIDE * 2 - 1) * 1.2, -(rows / SIDE * 2 - 1) * 1.2
    inside = x**2 + y**2 < 0.5
    z = np.sqrt(np.clip(0.5 - x**2 - y**2, 0, None))
    normal = np.where(inside[..., None], np.stack([x, y, z], -1) / np.sqrt(0.5), [0.0, 0.0, 1.0])
    sky = (rows < 8) & ~inside
    normal[sky] = 0
    albedo = np.where(inside[..., None], rng.uniform(0.2, 0.9, 3), rng.uniform(0.2, 0.9, 3))
    towards = rng.normal(size=(3, 3)) + np.array([0, 0, 1.5])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lamps = [np.repeat((normal @ d).clip(0)[..., None], 3, axis=2) for d in towards]
    world = (0.5 + 0.3 * normal[..., 1:2]) * np.array([0.8, 1.0, 1.2])
    lumi = np.stack([*lamps, world]).astype(np.float32)
    lumi[:, sky] = 0
    lumi *= (0.25 / lumi.mean(axis=(1, 2, 3), keepdims=True)).astype(np.float32)
    images = (lumi * albedo).astype(np.float32)
    images[-1][sky] = 0.6
    return Rendered(
        name=f"ball{seed}",
        images=images,
        lumi=lumi,
        world=np.array([False, False, False, True]),
        normal=normal.astype(np.float32),
        albedo=albedo.astype(np.float32),
        depth=np.where(sky, 1e3, 4 - z).astype(np.float32),
        ids=np.where(inside, 2, 1).astype(np.int32),
        sky=sky,
        slope=0.3,
    )
