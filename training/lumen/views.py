"""Rendered views as bytes on a device, and the encoding of light in bytes.

Light x of a source whose brightest value is m becomes round(255 log(1 + 400 x / m) / log 401): steps of 1.2
to 2.4 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

STRENGTH = 400.0


def to_code(light: Tensor, most: Tensor) -> Tensor:
    """Return light 0..most as uint8 codes."""
    code = torch.log1p(STRENGTH * (light / most).clamp(0, 1)) * (255 / math.log1p(STRENGTH))
    return code.round().to(torch.uint8)


def from_code(code: Tensor, most: Tensor) -> Tensor:
    """Invert `to_code`."""
    return torch.expm1(code.float() * (math.log1p(STRENGTH) / 255)) * (most / STRENGTH)


@dataclass(frozen=True)
class Views:
    """V views of K sources each, H x W pixels; views with fewer sources are filled with dark ones."""

    images: Tensor  # (V, K, 3, H, W) uint8 codes of the picture under each source alone
    lumi: Tensor  # (V, K, 3, H, W) uint8 codes of its Lumi map
    image_most: Tensor  # (V, K) float32, brightest value of each picture
    lumi_most: Tensor  # (V, K) float32
    usable: Tensor  # (V, K) bool: whether a source lights enough of the view
    world: Tensor  # (V, K) bool: the source is the environment
    normal: Tensor  # (V, 3, H, W) uint8: 127.5 (n + 1), camera space, x right, y up, z towards the camera
    albedo: Tensor  # (V, 3, H, W) uint8, sRGB
    depth: Tensor  # (V, 1, H, W) uint8: logarithm of the distance along the view axis, see `depth_range`
    depth_range: Tensor  # (V, 2) float32: logarithm of the nearest and of the farthest distance
    ids: Tensor  # (V, 1, H, W) uint8: the object's number; 255 is sky
    slope: Tensor  # (V,) float32: tangent of half the angle of view

    def __len__(self) -> int:
        return self.images.shape[0]

    @property
    def size(self) -> int:
        return self.images.shape[-1]

    def to(self, device: torch.device | str) -> Views:
        return Views(*(getattr(self, field.name).to(device) for field in fields(self)))
