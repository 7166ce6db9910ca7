"""The form in which the network receives strokes.

A drawing has one blend mode. Strokes of several modes are run as several drawings.

    set        the light under the strokes is the drawn light
    add        one more lamp: the light under the strokes is the photo's own plus the drawn light
    multiply   a flag or a gel: the light under the strokes is the photo's own times the drawn factor
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from dior_rt.training.light import encode_lumi
from dior_rt.training.lumen.config import SIDE
from dior_rt.training.lumen.optics import log_light, luminance, spread

SET, ADD, MULTIPLY = 0, 1, 2
LEAST_FACTOR: Final = 0.02  # the smallest factor, which keeps its logarithm finite
NEAR: Final = 1 / 16  # share of the grid's side over which strokes inform their surroundings
FAR: Final = 1 / 4
LITTLE: Final = 1e-3
CHANNELS: Final = 7  # ratio, light, mask
PALETTE: Final = 4  # drawn colours: nearby, farther, everywhere; and the photo's own light


def log_factor(drawn: Tensor) -> Tensor:
    """Return the logarithm of the factor on the light of `multiply` strokes."""
    return torch.log(drawn.clamp_min(LEAST_FACTOR))


def peak(drawn: Tensor, mask: Tensor) -> Tensor:
    """Return (B, 1, 1, 1), the brightest drawn luminance.

    `add` strokes are divided by it so that they stay linear.
    """
    return luminance(drawn * mask).amax(dim=(2, 3), keepdim=True).clamp_min(1e-4)


def stroke_features(drawn: Tensor, mask: Tensor, blend: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return the features of strokes (B, 3, H, W) and mask (B, 1, H, W) in modes (B,), and of the photo's
    light.

    The result is (B, 21, H, W): log-ratio, encoded light and mask, as drawn, spread nearby and spread far;
    and the colours (B, 4, 3, H, W) of luminance 1 that completed light may be mixed from.
    """
    mode = blend[:, None, None, None]
    is_set, is_add = (mode == SET).to(drawn), (mode == ADD).to(drawn)
    is_multiply = 1 - is_set - is_add
    ratio = is_set * (log_light(drawn) - log_light(light)) + is_multiply * log_factor(drawn)
    code = encode_lumi(drawn * is_set + drawn / peak(drawn, mask) * is_add)
    values = torch.cat([ratio, code], dim=1)
    near, far = (around(values, mask, share * SIDE) for share in (NEAR, FAR))
    features = torch.cat([values * mask, mask, near, far], dim=1)
    return features, drawn_colours(drawn, mask, light)


def around(values: Tensor, mask: Tensor, deviation: float) -> Tensor:
    """Return the mean of the strokes around every cell, and the amount drawn there: (B, C + 1, H, W)."""
    ones = torch.ones_like(mask)
    return spread(torch.cat([values, ones], dim=1), mask, deviation, LITTLE)


def drawn_colours(drawn: Tensor, mask: Tensor, light: Tensor) -> Tensor:
    """Return (B, 4, 3, H, W), the drawn colour nearby, farther off and everywhere, and the photo's own.

    All have luminance 1.
    """
    white = drawn.new_full((1, 3, 1, 1), 1e-3)
    everywhere = (drawn * mask).mean(dim=(2, 3), keepdim=True).expand_as(drawn)
    near, far = (spread(drawn, mask, share * SIDE, 1e-6) for share in (NEAR, FAR))
    # Where nothing is drawn nearby, the farther colour replaces it.
    choices = [near + 0.01 * far + 1e-4 * everywhere, far + 0.01 * everywhere, everywhere, light]
    stacked = torch.stack([choice + white for choice in choices], dim=1)
    return stacked / luminance(stacked.transpose(1, 2)).transpose(1, 2)
