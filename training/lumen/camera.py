"""A batched camera, which makes linear renders resemble real photos.

It has the same picture style as `camera.Camera`.

    linear light -> blur -> noise -> picture style -> sharpening -> 8 bits

The style applies to photo and relit picture alike. All other stages apply only to the photo.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from dior_rt.training.light import linear_to_srgb
from dior_rt.training.lumen.optics import blur, luminance

PLAIN_SHARE = 0.3  # share of cameras that do nothing but encode


@dataclass(frozen=True)
class Cameras:
    """One camera per sample, each field (B, 1, 1, 1).

    gamma: v ** gamma of the encoded value. contrast: the strength of an S-curve. lift: the value of black.
    saturation: relative to the luma. noise: standard deviation at white, which falls with the root of the
    light. sharpening: the share of the detail lost to a blur of 0.7 cells that is added.
    """

    gamma: Tensor
    contrast: Tensor
    lift: Tensor
    saturation: Tensor
    noise: Tensor
    sharpening: Tensor

    def develop(self, linear: Tensor) -> Tensor:
        """Return the picture of linear light (B, 3, H, W), encoded, in 0..1, not rounded."""
        v = linear_to_srgb(linear.clamp(0, 1)) ** self.gamma
        v = v + self.contrast * (v * v * (3 - 2 * v) - v)
        v = self.lift + (1 - self.lift) * v
        return (v + (self.saturation - 1) * (v - luminance(v))).clamp(0, 1)

    def shoot(self, linear: Tensor, generator: Generator) -> Tensor:
        """Return the photo of linear light: multiples of 1/255 in 0..1."""
        grain = torch.randn(linear.shape, generator=generator, device=linear.device)
        deviation = self.noise * torch.sqrt(linear.clamp(0, 1) + 0.02)
        photo = self.develop(linear + deviation * grain)
        photo = photo + self.sharpening * (photo - blur(photo, 0.7))
        return (photo.clamp(0, 1) * 255).round() / 255


def random_cameras(count: int, generator: Generator, device: torch.device) -> Cameras:
    """Return cameras of common kinds, mild in style."""

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, 1, generator=generator, device=device)

    styled = (uniform(0, 1) > PLAIN_SHARE).float()
    grain = 10 ** uniform(-3.0, -1.6)
    return Cameras(
        gamma=torch.exp(styled * 0.07 * torch.randn(count, 1, 1, 1, generator=generator, device=device)),
        contrast=styled * uniform(-0.15, 0.4),
        lift=styled * (uniform(0, 1) < 0.3) * uniform(0, 0.03),
        saturation=1 + styled * uniform(-0.15, 0.2),
        noise=styled * grain,
        sharpening=styled * uniform(0, 0.5),
    )
