"""Networks that are tried beside the one that ships: a flow about a frozen estimate, and severed patches."""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from dior_rt.training.network import Mini, velocity


class AboutEstimate(nn.Module):
    """A flow about the answer m of a frozen network: of z = x - (1 - sigma) m, whose image is x0 - m.

    Where z has the velocity u, x has u - m, so this is a network like any other. The flow's own answer is
    a relit picture; less m it is the middle of z's Gaussian.
    """

    def __init__(self, estimate: nn.Module, flow: nn.Module) -> None:
        super().__init__()
        self.estimate, self.flow = deepcopy(estimate).requires_grad_(False), flow

    def forward(
        self, x: Tensor, sigma: Tensor, with_own: bool = False, **seen: Tensor
    ) -> Tensor | tuple[Tensor, Tensor]:
        """As `Mini`'s; seen: photo, light, mask and mode."""
        middle = -self.estimate(x=torch.zeros_like(x), sigma=torch.ones_like(sigma), **seen)
        s = sigma[:, None, None, None]
        towards, own = self.flow(x=x - (1 - s) * middle, sigma=sigma, with_own=True, **seen)
        # A velocity is linear in the state and in the answer that is expected, which `middle` is taken from.
        towards = towards - velocity(torch.zeros_like(x), s, middle) - middle
        return (towards, own) if with_own else towards


def sever(network: Mini) -> None:
    """Let nothing after the transformer look beyond its own cell, now and in training."""
    network.mix = nn.Identity()
    for layer in (network.blend_quarter.blend, network.blend_half.blend, network.smooth, network.head):
        own = torch.zeros(layer.kernel_size)
        own[1, 1] = 1
        with torch.no_grad():
            layer.weight *= own
        layer.weight.register_hook(own.mul)  # of the gradient; AdamW leaves at 0 what is and has none
