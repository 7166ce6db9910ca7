"""Read the scene from a photo: normals, depth, albedo, sky, and the light that lies on it.

The light is a sum of a few colours, each as strong as one smooth map says, so that it cannot hold the
picture's material; how bright it is depends on the surface's orientation:

    brightness(p) = decode(softplus(a(p) . (n(p), 1))),   light(p) = brightness(p) * sum_k share_k(p) colour_k

a and share come at half the resolution, the normals n at the full one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.training.light import decode_lumi, srgb_to_linear
from dior_rt.training.lumen.backbone import FEATURES, Backbone
from dior_rt.training.lumen.config import PATCH, LumenConfig
from dior_rt.training.lumen.layers import Block, Down, Residual, Up, rotations
from dior_rt.training.lumen.optics import double, luminance

NORMAL, DEPTH, SKY, ALBEDO = 3, 1, 1, 3  # channels of the geometry head
ORIENTATION = 4  # factors of the normal's three components and a constant on brightness
BOUNCES = 2  # light that has bounced nearby, and anywhere
COLOUR_RANGE = 1.2  # of the logarithm of a light colour's channels


class Scene(NamedTuple):
    """The scene of a photo, for a batch of (B, ., H, W)."""

    light: Tensor  # (B, 3, H, W) the photo's own Lumi map, linear
    normal: Tensor  # (B, 3, H, W) unit vectors: x right, y up, z towards the camera
    depth: Tensor  # (B, 1, H, W) logarithm, up to a constant
    sky: Tensor  # (B, 1, H, W) logit
    albedo: Tensor  # (B, 3, H, W) in 0..1
    bounce: Tensor  # (B, 2, H, W) shares of bounced light
    fine: Tensor  # (B, fine, H, W) features
    half: Tensor  # (B, half, H / 2, W / 2)
    quarter: Tensor  # (B, quarter, H / 4, W / 4)
    tokens: Tensor  # (B, width, H / 8, W / 8)


class SceneNetwork(nn.Module):
    """Convolutions down to tokens of 8 x 8 cells, a transformer over them, and convolutions back up."""

    def __init__(self, config: LumenConfig) -> None:
        super().__init__()
        self.config = config
        width, fine, half, quarter = config.width, config.fine, config.half, config.quarter
        self.backbone = Backbone()
        self.see = nn.Conv2d(6, fine, 3, padding=1)
        self.to_half = Down(fine, half, FEATURES[0])
        self.to_quarter = Down(half, quarter, FEATURES[1])
        self.to_tokens = Down(quarter, width, FEATURES[2])
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.scene_depth))
        self.up_quarter = Up(width, quarter)
        self.up_half = Up(quarter, half)
        self.up_fine = Up(half, fine)
        self.geometry = nn.Conv2d(fine, NORMAL + DEPTH + SKY + ALBEDO, 3, padding=1)
        self.light_features = Residual(half)
        self.light = nn.Conv2d(half, ORIENTATION + config.colours + BOUNCES, 3, padding=1)
        self.palette = nn.Sequential(
            nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, 3 * config.colours)
        )
        for head in (self.light, self.palette[2]):
            nn.init.normal_(head.weight, std=1e-3)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.light.bias[3] = 0.5  # type: ignore[index]
            self.light.bias[-BOUNCES:] = -2.0  # type: ignore[index]

    def forward(self, photo: Tensor) -> Scene:
        """Return the scene. photo: (B, 3, H, W), sRGB in 0..1, H and W multiples of 8."""
        rows, columns = photo.shape[2] // PATCH, photo.shape[3] // PATCH
        seen4, seen8, seen16 = self.backbone(double(photo))  # strides 2, 4 and 8 of the photo
        linear = srgb_to_linear(photo)
        fine = F.silu(
            self.see(torch.cat([2 * photo - 1, torch.log(linear + 0.01) / 3], dim=1))
        )  # (B, fine, H, W)
        half = self.to_half(fine, seen4)  # (B, half, H / 2, W / 2)
        quarter = self.to_quarter(half, seen8)  # (B, quarter, H / 4, W / 4)
        grid = self.to_tokens(quarter, seen16)  # (B, width, H / 8, W / 8)
        tokens = grid.flatten(2).transpose(1, 2)  # (B, rows * columns, width)
        turns = rotations(rows, columns, self.config.width // self.config.heads, photo.device)
        for block in self.blocks:
            tokens = block(tokens, turns)
        grid = tokens.transpose(1, 2).unflatten(2, (rows, columns))
        quarter = self.up_quarter(grid, quarter)
        half = self.up_half(quarter, half)
        fine = self.up_fine(half, fine)
        normal, depth, sky, albedo = self.geometry(fine).float().split((NORMAL, DEPTH, SKY, ALBEDO), dim=1)
        normal = F.normalize(normal + normal.new_tensor([0.0, 0.0, 0.1])[:, None, None], dim=1, eps=1e-4)
        pooled = torch.cat([tokens.mean(dim=1), tokens.amax(dim=1)], dim=1)
        light, bounce = self._light(self.light_features(half), pooled, normal)
        return Scene(light, normal, depth, sky, torch.sigmoid(albedo), bounce, fine, half, quarter, grid)

    def _light(self, half: Tensor, pooled: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return the light (B, 3, H, W), linear, and the shares of bounced light (B, 2, H, W)."""
        colours = self.config.colours
        maps = double(self.light(half).float())
        oriented, shares, bounce = maps.split((ORIENTATION, colours, BOUNCES), dim=1)
        code = (oriented[:, :3] * normal).sum(dim=1, keepdim=True) + oriented[:, 3:]
        bright = decode_lumi(F.softplus(code, beta=8.0).clamp(max=2.5))
        tint = palette(self.palette(pooled).float().unflatten(1, (colours, 3)))  # (B, colours, 3)
        mixed = torch.einsum("bkhw,bkc->bchw", torch.softmax(shares, dim=1), tint)
        return bright * mixed, F.softplus(bounce)


def palette(raw: Tensor) -> Tensor:
    """Return colours of luminance 1 from (B, K, 3) unbounded values."""
    colour = torch.exp(COLOUR_RANGE * torch.tanh(raw))
    return colour / luminance(colour.transpose(1, 2)).transpose(1, 2)
