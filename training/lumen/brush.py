"""Draw strokes as a user might, for a whole batch at once.

A stroke is a polyline of a few points with a round brush. It starts where the light matters, continues in a
slowly turning direction, and often stays on the object on which it started.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

POINTS = 4  # points of a stroke
MOST = 5  # strokes of a drawing


@dataclass(frozen=True)
class Brush:
    """The random choices of the strokes of a batch.

    count: (B,) strokes drawn, 1..MOST. radius: (B, MOST) half the width, in cells. step: (B, MOST) cells
    between points. turn: (B, MOST, POINTS) radians. keeps: (B, MOST) whether the stroke stays on its object.
    flat: (B,) whether a stroke has one value, its mean.
    """

    count: Tensor
    radius: Tensor
    step: Tensor
    turn: Tensor
    keeps: Tensor
    flat: Tensor


def random_brush(count: int, side: int, generator: Generator, device: torch.device) -> Brush:
    """Return a brush for every sample of a batch."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator, device=device)

    turns = torch.randn(count, MOST, POINTS, generator=generator, device=device) * 0.5
    turns[:, :, 0] = uniform(MOST) * 2 * torch.pi
    return Brush(
        count=(1 + (uniform() ** 1.5 * MOST).long()).clamp(max=MOST),
        radius=side * 0.012 * (0.075 / 0.012) ** uniform(MOST),
        step=side * 0.02 * (0.2 / 0.02) ** uniform(MOST),
        turn=turns,
        keeps=uniform(MOST) < 0.5,
        flat=uniform() < 0.6,
    )


def starts(interest: Tensor, generator: Generator) -> Tensor:
    """Return (B, MOST) cell numbers at which strokes start, in proportion to interest (B, 1, H, W) >= 0."""
    share = interest.flatten(1) + 1e-6 * interest.flatten(1).amax(dim=1, keepdim=True) + 1e-12
    return torch.multinomial(share, MOST, replacement=True, generator=generator)


def touched(brush: Brush, k: int, start: Tensor, ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mask (B, 1, H, W) of stroke k from cells `start` (B,), and its points (B, POINTS, 2) of x
    and y.

    ids: (B, 1, H, W) object numbers.
    """
    height, width = ids.shape[2], ids.shape[3]
    place = torch.stack([start % width, start // width], dim=1).float() + 0.5  # (B, 2)
    points = walk(place, brush.step[:, k], brush.turn[:, k])
    mask = distance(points, height, width) <= brush.radius[:, k, None, None].clamp_min(0.8)
    same = ids[:, 0] == ids.flatten(1).gather(1, start[:, None])[:, :, None]
    mask &= same | ~brush.keeps[:, k, None, None]
    return mask[:, None].float(), points


def draw(brush: Brush, value: Tensor, start: Tensor, ids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return strokes of a value (B, 3, H, W) from cells `start` (B, MOST).

    The result is drawn light, mask (B, 1, H, W), and the points (B, MOST, POINTS, 2) of all strokes. Strokes
    that are not drawn repeat the points of the first stroke.
    """
    drawn, mask = torch.zeros_like(value), torch.zeros_like(value[:, :1])
    paths: list[Tensor] = []
    for k in range(MOST):
        stroke, points = touched(brush, k, start[:, k], ids)
        is_drawn = k < brush.count
        stroke = stroke * is_drawn[:, None, None, None]
        mean = (value * stroke).sum(dim=(2, 3), keepdim=True) / stroke.sum(
            dim=(2, 3), keepdim=True
        ).clamp_min(1)
        laid = torch.where(brush.flat[:, None, None, None], mean, value)
        drawn = torch.where(stroke > 0, laid, drawn)
        mask = torch.maximum(mask, stroke)
        paths.append(torch.where(is_drawn[:, None, None], points, paths[0] if paths else points))
    return drawn, mask, torch.stack(paths, dim=1)


def walk(start: Tensor, step: Tensor, turn: Tensor) -> Tensor:
    """Return (B, POINTS, 2), the points of a stroke from its start."""
    angle = turn.cumsum(dim=1)
    moves = step[:, None, None] * torch.stack([torch.cos(angle), torch.sin(angle)], dim=2)
    return start[:, None] + torch.cat([torch.zeros_like(moves[:, :1]), moves[:, 1:].cumsum(dim=1)], dim=1)


def distance(points: Tensor, height: int, width: int) -> Tensor:
    """Return (B, H, W), the distance in cells from every cell's centre to a polyline (B, P, 2) of x and y."""
    y = torch.arange(height, device=points.device, dtype=points.dtype)[:, None] + 0.5
    x = torch.arange(width, device=points.device, dtype=points.dtype)[None, :] + 0.5
    nearest = None
    for k in range(points.shape[1] - 1):
        a, b = points[:, k, :, None, None], points[:, k + 1, :, None, None]
        along_x, along_y = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        length = (along_x**2 + along_y**2).clamp_min(1e-6)
        t = (((x - a[:, 0]) * along_x + (y - a[:, 1]) * along_y) / length).clamp(0, 1)
        squared = (x - a[:, 0] - t * along_x) ** 2 + (y - a[:, 1] - t * along_y) ** 2
        nearest = squared if nearest is None else torch.minimum(nearest, squared)
    assert nearest is not None
    return nearest.sqrt()
