"""The building blocks: transformer blocks over tokens, residual convolutions over cells, and changes of
stride.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.training.lumen.optics import double

LARGEST_LOGIT = 8.0
Turns = tuple[Tensor, Tensor]  # cosine and sine of each token's position


class Block(nn.Module):
    """Attention and MLP under adaptive norms (DiT). modulation: (B, 6, width), or None for plain norms."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.offset = nn.Parameter(torch.zeros(6, width))
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        with torch.no_grad():
            self.offset[2].fill_(0.3)
            self.offset[5].fill_(0.3)

    def forward(self, tokens: Tensor, turns: Turns, modulation: Tensor | None = None) -> Tensor:
        table = self.offset if modulation is None else self.offset + modulation  # (6, width) or (B, 6, width)
        shift1, scale1, gate1, shift2, scale2, gate2 = (
            part.unsqueeze(-2) for part in table.to(tokens.dtype).unbind(-2)
        )
        tokens = tokens + gate1 * self._attend(_norm(tokens) * (1 + scale1) + shift1, turns)
        hidden = F.gelu(self.up(_norm(tokens) * (1 + scale2) + shift2), approximate="tanh")
        return tokens + gate2 * self.down(hidden)

    def _attend(self, tokens: Tensor, turns: Turns) -> Tensor:
        q, k, v = self.qkv(tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        q, k = (
            rotate(F.normalize(q, dim=-1), turns),
            rotate(F.normalize(k, dim=-1), turns),
        )  # (B, heads, N, size)
        mixed = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, scale=LARGEST_LOGIT)
        return self.proj(mixed.transpose(1, 2).flatten(2))


def _norm(tokens: Tensor) -> Tensor:
    return F.layer_norm(tokens, tokens.shape[-1:])


def rotations(rows: int, columns: int, size: int, device: torch.device) -> Turns:
    """Return cosine and sine (rows * columns, size / 2) of the rotary position code (RoPE, arXiv 2104.09864).

    Half of the pairs depend on the row, half on the column, so any shape of grid works.
    """
    frequency = torch.exp(-math.log(100.0) * torch.arange(size // 4, device=device) / (size // 4))
    down = (torch.arange(rows, device=device)[:, None] * frequency)[:, None, :].expand(
        rows, columns, size // 4
    )
    along = (torch.arange(columns, device=device)[:, None] * frequency)[None, :, :].expand(
        rows, columns, size // 4
    )
    angle = torch.cat([down, along], dim=2).reshape(rows * columns, size // 2)
    return torch.cos(angle), torch.sin(angle)


def rotate(part: Tensor, turns: Turns) -> Tensor:
    """Rotate the pairs (part[i], part[i + size / 2]) of (B, H, N, size) by their position's angles."""
    cosine, sine = turns
    a, b = part.chunk(2, dim=-1)
    return torch.cat([a * cosine - b * sine, a * sine + b * cosine], dim=-1)


class Residual(nn.Module):
    """Two 3 x 3 convolutions added to their input; the second starts at 0."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(min(8, channels // 8), channels)
        self.first, self.second = (
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.Conv2d(channels, channels, 3, padding=1),
        )
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, cells: Tensor) -> Tensor:
        return cells + self.second(F.silu(self.first(F.silu(self.norm(cells)))))


class Down(nn.Module):
    """Halve both sides: (B, C, h, w) -> (B, out, h / 2, w / 2), with channels left for other features."""

    def __init__(self, channels: int, out: int, extra: int = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, 4, 2, 1)
        self.extra = nn.Conv2d(extra, out, 1) if extra else None
        self.refine = Residual(out)

    def forward(self, cells: Tensor, extra: Tensor | None = None) -> Tensor:
        cells = self.conv(cells)
        if self.extra is not None and extra is not None:
            cells = cells + self.extra(extra)
        return self.refine(cells)


class Up(nn.Module):
    """Double both sides and add a skip: (B, C, h, w) and (B, out, 2 h, 2 w) -> (B, out, 2 h, 2 w)."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(channels, out, 1)
        self.refine = Residual(out)

    def forward(self, cells: Tensor, skip: Tensor) -> Tensor:
        return self.refine(double(self.narrow(cells)) + skip)


def waves(sigma: Tensor, width: int) -> Tensor:
    """Return sinusoids (B, width) of flow times (B,), of 1 to 10 rad over 0..1."""
    frequency = torch.exp(torch.linspace(0.0, math.log(10.0), width // 2, device=sigma.device))
    angle = sigma[:, None] * frequency
    return torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)
