"""New materials for rendered views: every object is tinted, and some get the texture of a real surface.

A picture is approximately albedo times light, so a factor on an object's albedo is the same factor on its
pictures. The Lumi map does not change: the network learns that light does not depend on the material.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Generator, Tensor
from torch.nn import functional as F

from dior_rt.training.light import srgb_to_linear

OBJECTS = 256
TILE = 128
KEPT = 0.35  # share of samples whose materials stay unchanged
TEXTURED = 0.3  # share of the objects in the other samples that get a texture


def load_tiles(folder: Path, most: int = 1024) -> Tensor:
    """Return surface tiles (N, 3, 128, 128) uint8 from the sheets in a folder; N is 0 without sheets."""
    tiles: list[np.ndarray] = []
    for path in sorted(folder.glob("sheet*.webp")):
        sheet = np.asarray(Image.open(path).convert("RGB"))
        rows, columns = sheet.shape[0] // TILE, sheet.shape[1] // TILE
        cut = (
            sheet[: rows * TILE, : columns * TILE]
            .reshape(rows, TILE, columns, TILE, 3)
            .transpose(0, 2, 4, 1, 3)
        )
        tiles += [tile for tile in cut.reshape(-1, 3, TILE, TILE) if tile.any()]
    if not tiles:
        return torch.zeros(0, 3, TILE, TILE, dtype=torch.uint8)
    return torch.from_numpy(np.stack(tiles[:: max(1, len(tiles) // most)][:most]))


def factors(ids: Tensor, tiles: Tensor, generator: Generator) -> Tensor:
    """Return (B, 3, H, W), the factor on each cell's albedo. ids: (B, 1, H, W) object numbers."""
    count, device = ids.shape[0], ids.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    grey = 2 ** (1.6 * uniform(count, OBJECTS, 1) - 1.1)
    tint = torch.exp(
        0.45 * torch.randn(count, OBJECTS, 3, generator=generator, device=device) * uniform(count, OBJECTS, 1)
    )
    table = grey * tint
    flat = ids.flatten(1).long()
    factor = table.gather(1, flat[..., None].expand(-1, -1, 3)).transpose(1, 2).unflatten(2, ids.shape[2:])
    if len(tiles):
        textured = (uniform(count, OBJECTS) < TEXTURED).float().gather(1, flat).unflatten(1, ids.shape[1:])
        factor = factor * (1 + textured * (textures(tiles, count, ids.shape[-1], generator) - 1))
    kept = (uniform(count, 1, 1, 1) < KEPT) | (ids == OBJECTS - 1)
    return torch.where(kept, torch.ones_like(factor), factor)


def textures(tiles: Tensor, count: int, side: int, generator: Generator) -> Tensor:
    """Return (B, 3, side, side), a turned and scaled tile for each sample, with mean 1 in each channel."""
    device = tiles.device
    which = torch.randint(len(tiles), (count,), generator=generator, device=device)
    tile = srgb_to_linear(tiles[which].float() / 255) + 0.02
    tile = tile / tile.mean(dim=(1, 2, 3), keepdim=True)
    angle = torch.rand(count, generator=generator, device=device) * 2 * torch.pi
    zoom = 0.3 * (1.2 / 0.3) ** torch.rand(count, generator=generator, device=device)
    line = torch.linspace(-1, 1, side, device=device)
    y, x = torch.meshgrid(line, line, indexing="ij")
    c, s = (zoom * torch.cos(angle))[:, None, None], (zoom * torch.sin(angle))[:, None, None]
    grid = torch.stack([c * x - s * y, s * x + c * y], dim=3)
    return F.grid_sample(tile, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
