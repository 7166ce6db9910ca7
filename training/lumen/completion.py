"""Complete the light: predict the whole Lumi map that the user meant from strokes and a scene.

One network serves three blend modes. Its head returns four maps: the share of the photo's own light that is
kept, the brightness of the new light (by orientation, as in `scene`), its mixture of the drawn colours, and
the reach of a factor:

    set        target = light * keep + new
    add        target = light + new * peak(drawn)        (linear in the drawn value; it never darkens)
    multiply   target = light * exp(reach * log drawn)

Where something is drawn, the drawn value holds in the mean: see `hold`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.light import BOUNCED
from dior_rt.training.light import decode_lumi, encode_lumi
from dior_rt.training.lumen.config import PATCH, SIDE, LumenConfig
from dior_rt.training.lumen.layers import Block, Down, Residual, Up, rotations, waves
from dior_rt.training.lumen.optics import log_light, spread
from dior_rt.training.lumen.scene import Scene
from dior_rt.training.lumen.strokes import (
    ADD,
    CHANNELS,
    FAR,
    LITTLE,
    MULTIPLY,
    NEAR,
    PALETTE,
    SET,
    log_factor,
    peak,
    stroke_features,
)

ORIENTATION: Final = 4
STATE: Final = 3  # channels of the flow's state
SCENE: Final = 3 + 3 + 1 + 1 + 3  # photo, normal, depth, sky, light
MODES: Final = 6  # three blends, each with or without light far from the strokes
HIDING_RATIO: Final = 0.1  # noise ten times as strong as the image hides half of the state
HOLD: Final = 0.03  # of the grid's side: how finely the drawn value holds
EDGE: Final = 0.2  # share of drawn cells around a cell at which half of the correction is left
FACTOR_SCALE: Final = 1 / 2.0  # of a log factor in the flow's data variable


class Strokes(NamedTuple):
    """A batch of drawings."""

    drawn: Tensor  # (B, 3, H, W) linear light, or a factor for `multiply`
    mask: Tensor  # (B, 1, H, W) in 0..1
    blend: Tensor  # (B,) SET, ADD or MULTIPLY
    far: Tensor  # (B,) 1: the network decides about places far from the strokes; 0: the photo stays there


class Completed(NamedTuple):
    """The light that the strokes ask for."""

    target: Tensor  # (B, 3, H, W) the target Lumi map, linear
    factor: Tensor  # (B, 3, H, W) logarithm of a factor on the light as it is seen; 0 but for `multiply`
    x0: Tensor  # (B, 3, H, W) the flow's data variable


class LightNetwork(nn.Module):
    """Convolutions over strokes and scene, a transformer under adaptive norms, and convolutions back up."""

    def __init__(self, config: LumenConfig) -> None:
        super().__init__()
        self.config = config
        width, fine, half, quarter = config.width, config.fine, config.half, config.quarter
        self.see = nn.Conv2d(3 * CHANNELS + STATE + SCENE, fine, 3, padding=1)
        self.to_half = Down(fine, half, half)
        self.to_quarter = Down(half, quarter, quarter)
        self.to_tokens = Down(quarter, width, width)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.mode = nn.Embedding(MODES, width)
        self.modulation = nn.Linear(width, 6 * width)
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.light_depth))
        self.up_quarter = Up(width, quarter)
        self.up_half = Up(quarter, half)
        self.up_fine = Up(half, fine)
        self.scene_fine = nn.Conv2d(fine, fine, 1)
        self.last = Residual(fine)
        self.mode_fine = nn.Embedding(MODES, fine)
        self.head = nn.Conv2d(fine, 1 + ORIENTATION + PALETTE + 1, 3, padding=1)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.head.bias[4] = -0.3  # type: ignore[index]  # next to no new light
            self.head.bias[5] = 2.0  # type: ignore[index]  # of the colour drawn nearby

    def forward(self, x: Tensor, sigma: Tensor, photo: Tensor, scene: Scene, strokes: Strokes) -> Completed:
        """Return the completed light. x: (B, 3, H, W), the flow's state at times sigma (B,)."""
        rows, columns = photo.shape[2] // PATCH, photo.shape[3] // PATCH
        features, colours = stroke_features(strokes.drawn, strokes.mask, strokes.blend, scene.light)
        clear = clarity(sigma)
        mode = strokes.blend * 2 + strokes.far
        depth = scene.depth - scene.depth.mean(dim=(2, 3), keepdim=True)
        seen = [photo, scene.normal, depth, torch.sigmoid(scene.sky), encode_lumi(scene.light)]
        state = x * clear[:, None, None, None]
        fine = self.see(torch.cat([features, state, *seen], dim=1)) + self.scene_fine(scene.fine)
        fine = F.silu(fine + self.mode_fine(mode)[:, :, None, None])  # (B, fine, H, W)
        half = self.to_half(fine, scene.half)  # (B, half, H / 2, W / 2)
        quarter = self.to_quarter(half, scene.quarter)  # (B, quarter, H / 4, W / 4)
        grid = self.to_tokens(quarter, scene.tokens)  # (B, width, H / 8, W / 8)
        visible_time = 1 - (1 - sigma) * clear  # a state without information hides the time, too
        condition = F.silu(self.time(waves(visible_time, self.config.width)) + self.mode(mode))
        modulation = self.modulation(condition).unflatten(1, (6, -1))  # (B, 6, width)
        tokens = grid.flatten(2).transpose(1, 2)
        turns = rotations(rows, columns, self.config.width // self.config.heads, photo.device)
        for block in self.blocks:
            tokens = block(tokens, turns, modulation)
        grid = tokens.transpose(1, 2).unflatten(2, (rows, columns))
        quarter = self.up_quarter(grid, quarter)
        half = self.up_half(quarter, half)
        fine = self.last(self.up_fine(half, fine))
        return compose(self.head(fine).float(), colours, scene, strokes)


def compose(maps: Tensor, colours: Tensor, scene: Scene, strokes: Strokes) -> Completed:
    """Return the light that the head's maps (B, 10, H, W) describe."""
    keep, oriented, shares, reach = maps.split((1, ORIENTATION, PALETTE, 1), dim=1)
    drawn, mask, light = strokes.drawn, strokes.mask, scene.light
    mode = strokes.blend[:, None, None, None]
    is_set, is_add, is_multiply = (mode == SET).float(), (mode == ADD).float(), (mode == MULTIPLY).float()
    code = (oriented[:, :3] * scene.normal).sum(dim=1, keepdim=True) + oriented[:, 3:]
    bright = decode_lumi(F.softplus(code, beta=8.0).clamp(max=2.5))
    tint = (torch.softmax(shares, dim=1)[:, :, None] * colours).sum(dim=1)  # (B, 3, H, W)
    scale = is_set + is_add * peak(drawn, mask)
    anything = (mask.amax(dim=(1, 2, 3), keepdim=True) > 0).float()  # without strokes nothing changes
    new = anything * bright * tint
    kept = light * torch.exp(anything * is_set * (3 * torch.tanh(keep / 3)))
    added = hold(new, drawn / scale.clamp_min(1e-6), mask * is_add)
    target = hold(kept + new * is_set, drawn, mask * is_set) + is_add * scale * added
    factor = is_multiply * _factor(reach, drawn, mask)
    target = target * torch.exp(factor)
    code = is_set * target + is_add * added
    x0 = (1 - is_multiply) * (2 * encode_lumi(code) - 1) + FACTOR_SCALE * factor
    return Completed(target, factor, x0)


def _factor(reach: Tensor, drawn: Tensor, mask: Tensor) -> Tensor:
    """Return the logarithm of the factor everywhere: the drawn factor nearby, as far as `reach` lets it
    extend.
    """
    wanted = log_factor(drawn)
    near, far = spread(wanted, mask, NEAR * SIDE, 1e-6), spread(wanted, mask, FAR * SIDE, 1e-6)
    share = spread(torch.ones_like(mask), mask, NEAR * SIDE, LITTLE)
    factor = torch.sigmoid(reach - 2) * (share * near + (1 - share) * far)
    return factor + held(wanted - factor, mask)


def hold(light: Tensor, drawn: Tensor, mask: Tensor) -> Tensor:
    """Return light (B, 3, H, W) that equals the drawn light under the mask, in the mean over a few cells.

    The correction is a ratio that varies slowly, so it preserves the shading of the light under a stroke.
    """
    error = log_light(drawn) - log_light(light)
    corrected = log_light(light) + held(error, mask)
    return torch.where(mask.amax(dim=(1, 2, 3), keepdim=True) > 0, _from_log(corrected), light)


def _from_log(logarithm: Tensor) -> Tensor:
    return (torch.exp(logarithm) - BOUNCED).clamp_min(0)


def held(error: Tensor, mask: Tensor) -> Tensor:
    """Return a slowly varying correction that removes the error under the mask and fades out beside it."""
    beside = spread(torch.ones_like(mask), mask, HOLD * SIDE, EDGE) * (1 + EDGE)
    amount = torch.maximum(mask, beside.clamp(max=1))
    correction = torch.zeros_like(error)
    for deviation in (2 * HOLD * SIDE, HOLD * SIDE):
        correction = correction + amount * spread(error - correction, mask, deviation)
    return correction


def clarity(sigma: Tensor) -> Tensor:
    """Return (B,) in 0..1, the weight of a state. Near noise it contains no information about the answer."""
    image, noise = (1 - sigma) ** 2, (HIDING_RATIO * sigma) ** 2
    return image / (image + noise)
