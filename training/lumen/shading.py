"""Turn a photo and two lights into the picture: the quotient of the lights, with bounced light in both.

    relit = (photo + e) * exp(r) - e      r = log((T + B(T) + b) / (S + B(S) + b)) + factor

S and T are the source and target Lumi maps, B(L) = near * blur(L) + far * mean(L) is the
bounced light, with the shares `near` and `far` that the scene network reads from the photo. Equal lights
return the photo, bit for bit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dior_rt.light import BOUNCED
from dior_rt.training.light import FLOOR, linear_to_srgb, srgb_to_linear
from dior_rt.training.lumen.config import SIDE
from dior_rt.training.lumen.optics import blur

NEARBY = 1 / 10  # share of the grid's side over which light bounces


def bounced(light: Tensor, bounce: Tensor) -> Tensor:
    """Return light (B, 3, H, W) with its bounced part. bounce: (B, 2, H, W)."""
    near, far = bounce[:, :1], bounce[:, 1:]
    return light + near * blur(light, NEARBY * SIDE) + far * light.mean(dim=(2, 3), keepdim=True) + BOUNCED


def log_ratio(source: Tensor, target: Tensor, bounce: Tensor, factor: Tensor) -> Tensor:
    """Return (B, 3, H, W), the logarithm of the change of the picture's light."""
    return torch.log(bounced(target, bounce) / bounced(source, bounce)) + factor


def relight(photo: Tensor, ratio: Tensor) -> Tensor:
    """Return the relit picture, linear and not clipped, of a photo that is sRGB-encoded in 0..1."""
    return (srgb_to_linear(photo) + FLOOR) * torch.exp(ratio.clamp(-6, 6)) - FLOOR


def shown(linear: Tensor) -> Tensor:
    """Return the picture as the display shows it, with a small slope outside its range so that training can
    return.
    """
    inside = linear.clamp(0, 1)
    return linear_to_srgb(inside) + 0.05 * (linear - inside).clamp(-1, 1)
