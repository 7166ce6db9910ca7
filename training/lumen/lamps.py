"""Compute the light of a small lamp close before the surface that a dab touches, from positions and normals.

A lone dab gives little information about the rest of the picture, so its light needs a cause: a lamp whose
light falls off with the square of the distance and with the angle to each surface. A wall behind the object
is farther from the lamp than the object's own surface, so the light belongs to the object.
"""

from __future__ import annotations

import torch
from torch import Tensor


def positions(depth: Tensor, slope: Tensor, frame: Tensor) -> Tensor:
    """Return (B, 3, H, W) camera-space positions: x right, y up, z towards the camera (negative before it).

    depth: (B, 1, H, W) along the view axis. slope: (B,) tangent of half the angle of view. frame: (B, 2, H,
    W), the place of each cell in the full square picture, -1..1, x to the right and y up.
    """
    return torch.cat([frame * slope[:, None, None, None] * depth, -depth], dim=1)


def lamp_light(position: Tensor, normal: Tensor, lamp: Tensor, size: Tensor) -> Tensor:
    """(B, 1, H, W): the direct light of a point lamp at (B, 3), without shadows, up to its strength.

        max(n . l, 0) / (d^2 + size^2)

    size: (B,) the lamp's radius, which keeps the light finite beside it.
    """
    towards = lamp[:, :, None, None] - position
    squared = towards.square().sum(dim=1, keepdim=True)
    cosine = (normal * towards).sum(dim=1, keepdim=True) / squared.clamp_min(1e-8).sqrt()
    return cosine.clamp_min(0) / (squared + size[:, None, None, None] ** 2)


def at(cells: Tensor, index: Tensor) -> Tensor:
    """Return (B, C), the values of (B, C, H, W) at flat cell numbers (B,)."""
    flat = cells.flatten(2)
    return flat.gather(2, index[:, None, None].expand(-1, flat.shape[1], 1))[:, :, 0]


def cells_at(points: Tensor, height: int, width: int) -> Tensor:
    """Return (B, P), the cell numbers of points (B, P, 2) of x and y, moved into the picture."""
    x = points[..., 0].long().clamp(0, width - 1)
    y = points[..., 1].long().clamp(0, height - 1)
    return y * width + x


def lamps_along(
    position: Tensor, normal: Tensor, cells: Tensor, height: Tensor, aside: Tensor, on: Tensor
) -> Tensor:
    """Return (B, 1, H, W), the light of lamps over the cells (B, P), each at `height` (B,) along the normal
    there.

    aside: (B, 3) moves every lamp, in heights. on: (B, P), which of them shine.
    """
    total = torch.zeros_like(position[:, :1])
    for k in range(cells.shape[1]):
        lamp = at(position, cells[:, k]) + height[:, None] * (at(normal, cells[:, k]) + aside)
        total = total + on[:, k, None, None, None] * lamp_light(position, normal, lamp, 0.3 * height)
    return total


def nearest(position: Tensor, cells: Tensor) -> Tensor:
    """Return (B, 1, H, W), the distance in the scene from every cell to the nearest of the cells (B, P)."""
    least = None
    for k in range(cells.shape[1]):
        squared = (position - at(position, cells[:, k])[:, :, None, None]).square().sum(dim=1, keepdim=True)
        least = squared if least is None else torch.minimum(least, squared)
    assert least is not None
    return least.sqrt()
