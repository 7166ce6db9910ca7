"""Batched operations on light, beside those of `dior_rt.training.light`. Pictures are (B, C, H, W)."""

from __future__ import annotations

import torch
from torch import Tensor

from dior_rt.light import BOUNCED

LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709


def luminance(colour: Tensor) -> Tensor:
    """Return luminance: (B, 3, ...) -> (B, 1, ...)."""
    red, green, blue = LUMINANCE
    return red * colour[:, 0:1] + green * colour[:, 1:2] + blue * colour[:, 2:3]


def log_light(light: Tensor) -> Tensor:
    """Return the logarithm in which errors of light are measured. It is finite in the dark."""
    return torch.log(light + BOUNCED)


def gaussian_matrix(size: int, deviation: Tensor | float, like: Tensor) -> Tensor:
    """Return (size, size): row i holds the weights of all cells for cell i, which sum to 1."""
    place = torch.arange(size, dtype=torch.float32, device=like.device)
    weights = torch.exp(-0.5 * ((place[:, None] - place) / deviation) ** 2)
    return (weights / weights.sum(dim=1, keepdim=True)).to(like.dtype)


def blur(cells: Tensor, deviation: float) -> Tensor:
    """Blur (B, C, H, W) by a Gaussian of `deviation` cells. The border's weights are normalised."""
    down = gaussian_matrix(cells.shape[2], deviation, cells)
    across = gaussian_matrix(cells.shape[3], deviation, cells)
    return down @ cells @ across.T


def spread(values: Tensor, mask: Tensor, deviation: float, least: float = 1e-3) -> Tensor:
    """Return the mean of masked values around every cell (normalised convolution), fading to 0 far from the
    mask.

    values: (B, C, H, W). mask: (B, 1, H, W) in 0..1. least: the share of drawn cells at which half remains.
    """
    both = blur(torch.cat([values * mask, mask], dim=1).float(), deviation)
    return both[:, :-1] / (both[:, -1:] + least)


def double(cells: Tensor) -> Tensor:
    """Resample bilinearly to twice the sides.

    It uses slices, so its gradient needs no scattered additions.
    """
    for dim in (2, 3):
        first, last = cells.narrow(dim, 0, 1), cells.narrow(dim, cells.shape[dim] - 1, 1)
        before = torch.cat([first, cells.narrow(dim, 0, cells.shape[dim] - 1)], dim=dim)
        after = torch.cat([cells.narrow(dim, 1, cells.shape[dim] - 1), last], dim=dim)
        pair = torch.stack([0.25 * before + 0.75 * cells, 0.75 * cells + 0.25 * after], dim=dim + 1)
        cells = pair.flatten(dim, dim + 1)
    return cells
