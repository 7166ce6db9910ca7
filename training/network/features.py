"""Compute once per photo the features of photo and strokes that do not depend on flow time.

Drawn light enters as a log-ratio to the light on the photo as it is. Under a stroke the ratio is known;
beside strokes it is spread by Gaussians of several widths, and the network's gates decide how far each
spread holds.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from dior_rt.light import BOUNCED
from dior_rt.training.light import LUMI_SCALE, encode_lumi
from dior_rt.training.network.config import MASK, RGB

#: Largest encoded source light that is used: 820 times white, far below overflow.
BRIGHTEST: Final = 4.0
#: Share of drawn cells around a cell at which a spread has half weight.
HALF_SPREAD: Final = 0.01
#: Deviation, in cells, by which drawn light fades out beside a stroke.
FADE: Final = 3.0
#: Share of drawn cells within the fade at which the faded light has half weight.
HALF_FADE: Final = 0.15


class InputChannels(NamedTuple):
    """The 21 channels that the head needs at every step, three each, (B, 3, h, w)."""

    photo: Tensor  # sRGB-encoded
    linear: Tensor  # the photo in linear light
    white_lumi: Tensor  # encoded light on the photo if all surfaces were white paper
    under_strokes: Tensor  # log-ratio of drawn to source light under strokes, fading out beside them
    nearby: Tensor  # mean log-ratio of the strokes within half a patch, for the cells beside them
    farther: Tensor  # the same within a patch
    everywhere: Tensor  # the same over the whole picture

    @classmethod
    def from_channels(cls, channels: Tensor) -> InputChannels:
        """Split (B, 21, h, w)."""
        return cls(*channels.split(RGB, dim=1))

    def to_channels(self) -> Tensor:
        """Concatenate to (B, 21, h, w)."""
        return torch.cat(self, dim=1)


class Features(NamedTuple):
    """The features of photo and strokes. The field names are those of the exported graphs."""

    given: Tensor  # (B, 21, h, w), see InputChannels
    fine: Tensor  # (B, fine, h, w)
    half: Tensor  # (B, half, h / 2, w / 2)
    quarter: Tensor  # (B, quarter, h / 4, w / 4)
    tokens: Tensor  # (B, width, h / patch, w / patch)
    cosine: Tensor  # (B, h / patch, w / patch, width / heads / 2), rotary position code of the tokens
    sine: Tensor


def strokes_on_white(linear: Tensor, light: Tensor, mask: Tensor) -> Tensor:
    """Return strokes as (B, 4, h, w): log-ratio to the light of white paper under the mask, and the mask."""
    ratio = _log_light(light) - _log_light(linear)
    return torch.cat([ratio * mask, mask], dim=1)


def seen_channels(photo: Tensor, light: Tensor, mask: Tensor, linear: Tensor, patch: int) -> Tensor:
    """Return the input of the convolutions, (B, 18, h, w)."""
    strokes = strokes_on_white(linear, light, mask)
    spreads = [strokes, spread(strokes, patch), spread_everywhere(strokes)]
    return torch.cat([2 * photo - 1, encode_lumi(light) * mask, *spreads], dim=1)


def input_channels(
    photo: Tensor, light: Tensor, mask: Tensor, linear: Tensor, source_lumi: Tensor, patch: int
) -> InputChannels:
    """Return the channels that the head needs at every step. source_lumi: the light on the photo, encoded."""
    # Under a stroke the light is known: twice the drawn value gives twice the light, even before training.
    brightness = torch.exp(source_lumi.clamp(0.0, BRIGHTEST) * math.log1p(LUMI_SCALE))  # 1 + 8 L
    ratio = mask * (_log_light(light) - torch.log(brightness - (1 - LUMI_SCALE * BOUNCED)))
    return InputChannels(photo, linear, encode_lumi(linear), *ratio_beside_strokes(ratio, mask, patch))


def ratio_beside_strokes(ratio: Tensor, mask: Tensor, patch: int) -> list[Tensor]:
    """Return the last four InputChannels, given the log-ratio (B, 3, h, w) under the mask (B, 1, h, w)."""
    beside, strokes = 1 - mask, torch.cat([ratio, mask], dim=1)  # (B, 4, h, w)
    faded, share = around(strokes, FADE).split((RGB, MASK), dim=1)
    under = ratio + beside * (faded / (share + HALF_FADE))
    left = beside * (HALF_FADE / (share + HALF_FADE))  # the share that the fade leaves open
    spreads = [spread(strokes, patch / 2), spread(strokes, patch), spread_everywhere(strokes)]
    planes = [under, *(left * means[:, :RGB] for means in spreads)]
    # At the edge of a stroke the planes have a step, but the head's output is mixed with its neighbours. The
    # planes are mixed there as well, or a thin line would surround the stroke.
    mixed = mix_neighbours(mask)
    edge = 4 * mixed * (1 - mixed)
    return [plane + edge * (mix_neighbours(plane) - plane) for plane in planes]


def spread(strokes: Tensor, deviation: float) -> Tensor:
    """Return the mean of the strokes around every cell, and the amount drawn there.

    strokes: (B, 4, h, w), values that are 0 where the mask, the last channel, is 0. Returns (B, 4, h, w): the
    means over the drawn cells. The last channel is 0 where nothing is drawn and approaches 1 above 1 % drawn
    cells.
    """
    return _over_drawn(around(strokes, deviation))


def spread_everywhere(strokes: Tensor) -> Tensor:
    """Return the result of `spread` over the whole picture."""
    return _over_drawn(mean_of_picture(strokes).expand_as(strokes))


def around(cells: Tensor, deviation: float) -> Tensor:
    """Return the Gaussian mean around every cell, (B, C, h, w) -> (B, C, h, w); deviation in cells."""
    down, along = (_gaussian(size, deviation, cells) for size in cells.shape[2:])
    return down @ cells @ along.T


def repeat_border(cells: Tensor) -> Tensor:
    """Repeat the outermost cells once on every side: (B, C, h, w) to (B, C, h + 2, w + 2).

    These are slices, because torch.compile lays out the gradient of a replicating pad wrongly where channels
    lie side by side.
    """
    rows = torch.cat([cells[:, :, :1], cells, cells[:, :, -1:]], dim=2)
    return torch.cat([rows[..., :1], rows, rows[..., -1:]], dim=3)


def mix_neighbours(cells: Tensor) -> Tensor:
    """Mix every cell with its neighbours by 1, 2, 1 in both directions, (B, C, h, w) -> (B, C, h, w).

    Cells that are made of one token get separate weights, whose differences would show as a weave in a smooth
    sky. The mix removes any pattern with a period of two cells.
    """
    return F.avg_pool2d(F.avg_pool2d(repeat_border(cells), 2, 1), 2, 1)


def mean_of_picture(cells: Tensor) -> Tensor:
    """Return the mean of the whole picture: (B, C, h, w) -> (B, C, 1, 1)."""
    return cells.mean(dim=(2, 3), keepdim=True)


def _log_light(light: Tensor) -> Tensor:
    return torch.log(LUMI_SCALE * (light + BOUNCED))


def _gaussian(size: int, deviation: float, like: Tensor) -> Tensor:
    """Return (size, size): row i holds the weights of all cells for cell i, with a sum of 1."""
    place = torch.arange(size, dtype=like.dtype, device=like.device)
    weights = torch.exp(-0.5 * ((place[:, None] - place) / deviation) ** 2)
    return weights / weights.sum(dim=1, keepdim=True)


def _over_drawn(means: Tensor) -> Tensor:
    return means / (means[:, RGB:] + HALF_SPREAD)
