"""Mini's network: a diffusion transformer on the light grid that predicts light, not colours.

Convolutions see photo and strokes, a plain DiT works on tokens of 8 x 8 cells, and convolutions blend its
answer across the tokens' borders. The heads are physical. To relight, the network answers a log-ratio r for
every cell and channel,

    relit = (photo + e) exp(r) - e                               in linear light, e = 0.02

    r = raw + log((drawn + b) / (source + b))                    under a stroke, b = 0.02: bounced light
    r = raw + gates x spreads of the strokes' log-ratio          beside strokes

so an untrained network returns the photo where nothing is drawn, black can be lit, and twice the drawn
value is twice the light. `source` is the photo's own Lumi map, the answer to "estimate"; it is estimated
from the photo alone, before the strokes are seen. The velocity is that of a narrow Gaussian about the
answer.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.training.light import RELIT_SCALE, apply_log_ratio, linear_to_srgb, srgb_to_linear
from dior_rt.training.network.config import ANSWER, MODES, MODULATIONS, RGB, SEEN, Config
from dior_rt.training.network.features import Features, InputChannels, input_channels, seen_channels
from dior_rt.training.network.layers import (
    Blend,
    Block,
    DivideTokens,
    MixNeighbours,
    Refine,
    Rotation,
    layer_norm,
    rotations,
    time_features,
)

#: Gates are sigmoid(answer - CLOSED), so their first value is about an eighth.
CLOSED: Final = 2.0
#: With noise 1 / HIDING_RATIO times as strong as the image, half of the state is hidden from the network.
HIDING_RATIO: Final = 0.1
#: Deviation of x0 from the network's answer: about 0.12 in sRGB.
DEVIATION: Final = 0.5
#: The largest log-ratio, reached smoothly: 400 times the light, or a 400th.
LARGEST_LOG_RATIO: Final = 6.0
#: Slope of the answer outside the display's range, which keeps clipped cells trainable.
CLIPPED_SLOPE: Final = 0.05


class Mini(nn.Module):
    """Photo, strokes and noisy state -> velocity. docs/contracts.md describes inputs and output.

    `encode` runs once a photo and strokes; `step` runs at every step of the flow.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        width, patch = config.width, config.patch
        fine, half, quarter = config.fine, config.half, config.quarter
        self.see = nn.Conv2d(SEEN, fine, 3, padding=1)
        self.see_half = nn.Conv2d(fine, half, 4, 2, 1)
        self.see_quarter = nn.Conv2d(half, quarter, 4, 2, 1)
        self.refine = Refine(quarter)
        self.embed = nn.Conv2d(quarter, width, patch // 4, patch // 4)
        self.embed_state = nn.Conv2d(RGB, width, patch, patch)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.mode = nn.Embedding(MODES, width)
        self.modulation = nn.Linear(width, MODULATIONS * width)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.unembed = nn.Linear(width, quarter * (patch // 4) ** 2)
        self.divide_tokens = DivideTokens(patch // 4)
        self.blend_quarter = Blend(quarter, half)
        self.blend_half = Blend(half, fine)
        self.see_state = nn.Conv2d(RGB, fine, 3, padding=1)
        self.state_gate = nn.Linear(width, fine)
        self.smooth = nn.Conv2d(fine, fine, 3, padding=1)
        self.head = nn.Conv2d(fine, ANSWER, 3, padding=1)
        self.mix: nn.Module = MixNeighbours()
        for zero_at_first in (self.modulation, self.state_gate, self.head):
            for weight in zero_at_first.parameters():
                nn.init.zeros_(weight)

    def forward(
        self,
        x: Tensor,
        sigma: Tensor,
        photo: Tensor,
        light: Tensor,
        mask: Tensor,
        mode: Tensor,
        own: Tensor | None = None,
        with_source: bool = False,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Return the velocity; with `with_source` also the encoded source Lumi map.

        own: that map, where an earlier call has estimated it.
        """
        own = self.estimate_source(photo) if own is None else own
        result = self.step(x, sigma, mode, *self.encode(photo, light, mask, own))
        return (result, own) if with_source else result

    def estimate_source(self, photo: Tensor) -> Tensor:
        """Return the encoded source Lumi map (B, 3, h, w), estimated without strokes from a state of zeros.

        If the network saw the strokes, they would bias the estimate, because drawn light tends to resemble
        the light that is there. Twice the drawn light would then be less than twice the light.
        """
        zeros, sigma = torch.zeros_like(photo), torch.ones_like(photo[:, 0, 0, 0])
        blank = self.encode(photo, zeros, zeros[:, :1], zeros)
        return self._answers(zeros, sigma, sigma.long(), blank)[1]

    def encode(self, photo: Tensor, light: Tensor, mask: Tensor, own: Tensor) -> Features:
        """Compute the features that do not depend on flow time. own: the encoded source Lumi map."""
        linear, patch = srgb_to_linear(photo), self.config.patch
        fine = F.silu(self.see(seen_channels(photo, light, mask, linear, patch)))  # (B, fine, h, w)
        half = F.silu(self.see_half(fine))  # (B, half, h / 2, w / 2)
        quarter = self.refine(F.silu(self.see_quarter(half)))  # (B, quarter, h / 4, w / 4)
        tokens = self.embed(quarter)  # (B, width, h / patch, w / patch)
        given = input_channels(photo, light, mask, linear, own, patch)
        cosine, sine = self._rotation(tokens)
        return Features(given.to_channels(), fine, half, quarter, tokens, cosine, sine)

    def step(
        self,
        x: Tensor,
        sigma: Tensor,
        mode: Tensor,
        given: Tensor,
        fine: Tensor,
        half: Tensor,
        quarter: Tensor,
        tokens: Tensor,
        cosine: Tensor,
        sine: Tensor,
    ) -> Tensor:
        """Return the velocity at x and sigma from the features of `encode`."""
        features = Features(given, fine, half, quarter, tokens, cosine, sine)
        relit, own = self._answers(x, sigma, mode, features)
        expected = torch.where(mode[:, None, None, None] == 0, relit, 2 * own - 1)
        return velocity(x, sigma[:, None, None, None], expected)

    def _answers(self, x: Tensor, sigma: Tensor, mode: Tensor, features: Features) -> tuple[Tensor, Tensor]:
        """Return x0 of relighting, and the encoded source Lumi map, (B, 3, h, w) each."""
        visible = state_visibility(sigma)
        state = x * visible[:, None, None, None]
        time = 1 - (1 - sigma) * visible  # where the state is hidden, the flow time is hidden as well
        condition = F.silu(
            self.time(_twice(time_features(time, self.config.width))) + _twice(self.mode(mode))
        )  # (2 B, width)
        cells = self._transform(features, state, condition)  # (B, quarter, h / 4, w / 4)
        cells = self.blend_quarter(cells + features.quarter)  # (B, half, h / 2, w / 2)
        cells = self.blend_half(cells + features.half)  # (B, fine, h, w)
        gated = self.see_state(state) * self.state_gate(condition)[: x.shape[0], :, None, None]
        cells = F.silu(self.smooth(cells + features.fine + gated))
        raw, own, gates = self.mix(self.head(cells).float()).split(RGB, dim=1)  # (B, 3, h, w) each
        given = InputChannels.from_channels(features.given)
        near, far, wide = torch.sigmoid(gates - CLOSED).split(1, dim=1)  # (B, 1, h, w) each
        ratio = raw + given.under_strokes
        ratio = ratio + near * given.nearby + far * given.farther + wide * given.everywhere
        return relit_answer(given.photo, given.linear, ratio), given.white_lumi + own

    def _transform(self, features: Features, state: Tensor, condition: Tensor) -> Tensor:
        """Run the transformer and return features of 4 x 4 cells, (B, quarter, h / 4, w / 4).

        condition: (2 B, width); only the first half is used.
        """
        rotation = features.cosine.flatten(1, 2), features.sine.flatten(1, 2)  # (B, N, width / heads / 2)
        tokens = features.tokens + self.embed_state(state)  # (B, width, rows, columns)
        batch, _, rows, columns = tokens.shape
        tokens = tokens.flatten(2).transpose(1, 2)  # (B, N, width), N = rows * columns
        # The vectors of all blocks are computed at once, because six of them are too little work for one
        # product.
        start = torch.tensor([0.0, 1, 0, 0, 1, 0], device=tokens.device)[:, None]  # scales begin at 1
        offsets = torch.stack([block.get_parameter("offset") for block in self.blocks]) + start
        modulation = self.modulation(condition)[:batch].unflatten(1, (1, MODULATIONS, -1)) + offsets
        vectors = modulation.flatten(1, 2).split(1, dim=1)  # (B, 1, width) each
        for index, block in enumerate(self.blocks):
            tokens = block(tokens, vectors[MODULATIONS * index : MODULATIONS * (index + 1)], rotation)
        tokens = layer_norm(tokens.unflatten(1, (rows, columns)))
        return self.divide_tokens(tokens.movedim(3, 1), self.unembed)

    def _rotation(self, tokens: Tensor) -> Rotation:
        """Return the rotary position code of tokens (B, width, rows, columns): (B, rows, columns, d / 2)."""
        batch, width, rows, columns = tokens.shape
        cosine, sine = rotations(rows, columns, width // self.config.heads, tokens.device)
        cosine = cosine.unflatten(0, (rows, columns)).expand(batch, -1, -1, -1)
        sine = sine.unflatten(0, (rows, columns)).expand(batch, -1, -1, -1)
        return cosine, sine


def velocity(x: Tensor, sigma: Tensor, expected: Tensor) -> Tensor:
    """Return E[eps - x0 | x] where x = (1 - sigma) x0 + sigma eps, and x0 is Gaussian about `expected`.

    The result depends on `expected` near noise and on the state near the image. It never divides by sigma.
    """
    rest, variance = 1 - sigma, DEVIATION**2
    return ((sigma - rest * variance) * x - sigma * expected) / (rest**2 * variance + sigma**2)


def state_visibility(sigma: Tensor) -> Tensor:
    """Return (B,) in 0..1: the share of the state that the network sees.

    Near noise the state contains no information about the photo. It holds only a faint copy of the network's
    earlier answers, and the network must not treat these as evidence.
    """
    image, noise = (1 - sigma) ** 2, (HIDING_RATIO * sigma) ** 2
    return image / (image + noise)


def relit_answer(photo: Tensor, linear: Tensor, ratio: Tensor) -> Tensor:
    """Return x0 of relighting, 4 (relit - photo), for a log-ratio of light."""
    ratio = LARGEST_LOG_RATIO * torch.tanh(ratio / LARGEST_LOG_RATIO)
    relit = apply_log_ratio(linear, ratio)
    shown = relit.clamp(0, 1)
    return RELIT_SCALE * (linear_to_srgb(shown) + CLIPPED_SLOPE * (relit - shown).clamp(-1, 1) - photo)


def _twice(rows: Tensor) -> Tensor:
    """Repeat the rows. A product of one row is summed in another order than one of several rows.

    Without the repetition, a single picture would differ in its last bits from the same picture in a batch.
    """
    return torch.cat([rows, rows])
