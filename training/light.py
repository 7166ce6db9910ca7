"""The functions of `dior_rt.light` and the sRGB curve in torch. A test compares both."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dior_rt.light import FLOOR, LUMI_PEAK, LUMI_SCALE, RELIT_SCALE

__all__ = ["FLOOR", "LUMI_PEAK", "LUMI_SCALE", "RELIT_SCALE"]


def srgb_to_linear(encoded: Tensor) -> Tensor:
    """Return linear light (IEC 61966-2-1), for values in 0..1."""
    return torch.where(
        encoded <= 0.04045, encoded / 12.92, ((encoded.clamp_min(0.04) + 0.055) / 1.055) ** 2.4
    )


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Return sRGB-encoded values (IEC 61966-2-1) of light in 0..1.

    The linear part near black continues below 0.
    """
    return torch.where(
        linear <= 0.0031308,
        12.92 * linear,
        1.055 * linear.clamp_min(0.003) ** (1 / 2.4) - 0.055,
    )


def encode_lumi(light: Tensor, peak: float = 1.0) -> Tensor:
    """Return log(1 + 8 L) / log(1 + 8 peak): 0 for darkness, 1 for `peak`."""
    return torch.log1p(LUMI_SCALE * light) / math.log1p(LUMI_SCALE * peak)


def decode_lumi(encoded: Tensor, peak: float = 1.0) -> Tensor:
    """Return linear light: the inverse of `encode_lumi`; values below 0 count as 0."""
    return torch.expm1(encoded.clamp_min(0) * math.log1p(LUMI_SCALE * peak)) / LUMI_SCALE


def log_floored(light: Tensor) -> Tensor:
    """Return log(L + e), with e = FLOOR: differences of two are `dior_rt.light.log_ratio`."""
    return torch.log(light + FLOOR)


def apply_log_ratio(light: Tensor, ratio: Tensor) -> Tensor:
    """Return (L + e) exp(ratio) - e, with e = FLOOR.

    It may be slightly below 0, so that it stays trainable.
    """
    return (light + FLOOR) * torch.exp(ratio) - FLOOR


def draw_lumi(light: Tensor, peak: float = LUMI_PEAK) -> Tensor:
    """Return light as a picture 0..1, as the runtime draws it for qwen."""
    return encode_lumi(light, peak).clamp(0, 1)


def undraw_lumi(picture: Tensor, peak: float = LUMI_PEAK) -> Tensor:
    """Return linear light from a picture of a Lumi map: the inverse of `draw_lumi`."""
    return torch.expm1(picture * math.log1p(LUMI_SCALE * peak)) / LUMI_SCALE


def pack_patches(latents: Tensor, patch: int = 2) -> Tensor:
    """Return latents (z, h, w) as tokens (h w / patch^2, z patch^2), row by row."""
    channels, rows, columns = latents.shape
    split = latents.reshape(channels, rows // patch, patch, columns // patch, patch)
    return split.permute(1, 3, 0, 2, 4).reshape(-1, channels * patch**2)


def unpack_patches(tokens: Tensor, size: tuple[int, int], patch: int = 2) -> Tensor:
    """Return latents (z, h, w) from the tokens of (rows, columns): the inverse of `pack_patches`."""
    split = tokens.reshape(*size, -1, patch, patch).permute(2, 0, 3, 1, 4)
    return split.reshape(-1, size[0] * patch, size[1] * patch)
