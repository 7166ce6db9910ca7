"""Variants of the network for the studies: a flow around a frozen estimate, and severed patches."""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from dior_rt.training.network import Mini, velocity


class AboutEstimate(nn.Module):
    """A flow around the answer m of a frozen network: z = x - (1 - sigma) m, whose image is x0 - m.

    If z has the velocity u, then x has u - m, so this is a network like any other. The answer of the flow
    is a relit picture; minus m, it is the mean of z's Gaussian.
    """

    def __init__(self, estimate: nn.Module, flow: nn.Module) -> None:
        super().__init__()
        self.estimate, self.flow = deepcopy(estimate).requires_grad_(False), flow

    def forward(
        self, x: Tensor, sigma: Tensor, with_source: bool = False, **seen: Tensor
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Return what `Mini` returns. seen: photo, light, mask and mode."""
        middle = -self.estimate(x=torch.zeros_like(x), sigma=torch.ones_like(sigma), **seen)
        s = sigma[:, None, None, None]
        towards, source = self.flow(x=x - (1 - s) * middle, sigma=sigma, with_source=True, **seen)
        # A velocity is linear in the state and in the expected answer, from which `middle` is subtracted.
        towards = towards - velocity(torch.zeros_like(x), s, middle) - middle
        return (towards, source) if with_source else towards


def sever(network: Mini) -> None:
    """Restrict all layers after the transformer to their own cell, now and in training."""
    network.mix = nn.Identity()
    for layer in (network.blend_quarter.blend, network.blend_half.blend, network.smooth, network.head):
        centre = torch.zeros(layer.kernel_size)
        centre[1, 1] = 1
        with torch.no_grad():
            layer.weight *= centre
        layer.weight.register_hook(centre.mul)  # masks the gradient, so AdamW keeps the zeros
