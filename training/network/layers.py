"""The layers of the network: transformer blocks, and convolutions between cell sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.training.network.config import MODULATIONS, Config
from dior_rt.training.network.features import mix_neighbours

#: Cosine and sine of every token's position angles.
Rotation = tuple[Tensor, Tensor]

#: Queries and keys have unit length; this is the largest logit of the attention.
LARGEST_LOGIT: Final = 8.0
#: Longest and shortest wave of the sinusoids of flow time, in radians over 0..1.
TIME_FREQUENCIES: Final = (1.0, 10.0)
#: Ratio of the fastest to the slowest rotation of the position code.
POSITION_RANGE: Final = 100.0


class MixNeighbours(nn.Module):
    """`mix_neighbours` as a module, so that a study can leave it out."""

    def forward(self, cells: Tensor) -> Tensor:
        return mix_neighbours(cells)


class DivideTokens(nn.Module):
    """Divide every token into cells by a linear map: (B, width, rows, columns) to
    (B, C, factor * rows, factor * columns)."""

    def __init__(self, factor: int) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, tokens: Tensor, unembed: nn.Module) -> Tensor:
        cells = unembed(tokens.movedim(1, 3)).movedim(3, 1)
        return F.pixel_shuffle(cells, self.factor)


class Divide(nn.Conv2d):
    """Divide every cell into four: (B, C, h, w) to (B, finer, 2 h, 2 w)."""

    def __init__(self, size: int, finer: int) -> None:
        super().__init__(size, 4 * finer, 1)

    def forward(self, cells: Tensor) -> Tensor:
        return F.pixel_shuffle(super().forward(cells), 2)


class Refine(nn.Module):
    """Add a function of the neighbourhood to every cell's features: (B, C, h, w) -> (B, C, h, w).

    Zero at first.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.look, self.add = nn.Conv2d(size, size, 3, padding=1), nn.Conv2d(size, size, 3, padding=1)
        for weight in self.add.parameters():
            nn.init.zeros_(weight)

    def forward(self, cells: Tensor) -> Tensor:
        return cells + self.add(F.silu(self.look(cells)))


class Blend(nn.Module):
    """Blend neighbouring cells, so that no borders show, then divide each into four."""

    def __init__(self, size: int, finer: int) -> None:
        super().__init__()
        self.blend = nn.Conv2d(size, size, 3, padding=1)
        self.divide = Divide(size, finer)

    def forward(self, cells: Tensor) -> Tensor:
        return self.divide(F.silu(self.blend(cells)))


class Block(nn.Module):
    """Attention and MLP under adaptive norms (DiT, arXiv 2212.09748).

    All blocks share one modulation; each adds its own offset to it.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.offset = nn.Parameter(torch.zeros(MODULATIONS, width))
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, tokens: Tensor, modulation: Sequence[Tensor], rotation: Rotation) -> Tensor:
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation  # (B, 1, width) each
        tokens = tokens + gate1 * self._attend(layer_norm(tokens) * scale1 + shift1, rotation)
        hidden = F.gelu(self.up(layer_norm(tokens) * scale2 + shift2), approximate="tanh")
        return tokens + gate2 * self.down(hidden)  # (B, N, width)

    def _attend(self, tokens: Tensor, rotation: Rotation) -> Tensor:
        q, k, v = (
            self.qkv(tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        )  # (B, H, N, d) each
        # Queries and keys of unit length keep the logits small in every precision. The attention is written
        # out because the fused one's backward pass takes several times as long on CPUs for so few tokens.
        rotation = rotation[0].unsqueeze(1), rotation[1].unsqueeze(1)  # for all heads
        q, k = rotate(_unit(q), rotation), rotate(LARGEST_LOGIT * _unit(k), rotation)
        mixed = (q @ k.transpose(2, 3)).softmax(dim=-1) @ v  # (B, H, N, d)
        return self.proj(mixed.transpose(1, 2).flatten(2))  # (B, N, width)


def layer_norm(tokens: Tensor) -> Tensor:
    """Return the tokens with mean 0 and variance 1 each. The norm has no trained parameters."""
    return F.layer_norm(tokens, tokens.shape[-1:])


def _unit(part: Tensor) -> Tensor:
    return F.normalize(part, dim=-1)


def time_features(sigma: Tensor, width: int) -> Tensor:
    """Return sinusoids (B, width) of flow times (B,), of 1 to 10 rad over 0..1.

    Faster sinusoids would let the velocity change with sigma more quickly than a solver's steps can follow.
    """
    slowest, fastest = (math.log(frequency) for frequency in TIME_FREQUENCIES)
    frequency = torch.exp(torch.linspace(slowest, fastest, width // 2, device=sigma.device))
    angle = sigma[:, None] * frequency
    return torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)


def rotations(rows: int, columns: int, size: int, device: torch.device) -> Rotation:
    """Return cosine and sine (rows * columns, size / 2) of the rotary position code (RoPE, arXiv 2104.09864).

    Half of the angles depend on the row, half on the column. No parameter is trained, so any shape of grid
    works.
    """
    quarter = size // 4
    frequency = torch.exp(-math.log(POSITION_RANGE) * torch.arange(quarter, device=device) / quarter)
    down = torch.arange(rows, device=device)[:, None] * frequency
    along = torch.arange(columns, device=device)[:, None] * frequency
    down = down[:, None, :].expand(rows, columns, quarter)
    along = along[None, :, :].expand(rows, columns, quarter)
    angle = torch.cat([down, along], dim=2).reshape(rows * columns, size // 2)
    return torch.cos(angle), torch.sin(angle)


def rotate(part: Tensor, rotation: Rotation) -> Tensor:
    """Rotate the pairs (part[i], part[i + size / 2]) of (B, H, N, size) by their position's angles."""
    cosine, sine = rotation
    a, b = part.chunk(2, dim=-1)
    return torch.cat([a * cosine - b * sine, a * sine + b * cosine], dim=-1)
