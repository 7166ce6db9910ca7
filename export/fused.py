"""Mini in larger ONNX operators: the same function in half as many nodes, which run faster on CPUs.

Since opset 23, rotary positions and normalising vectors are one operator each. A linear map whose output is
spread over finer cells is a transposed convolution. Attention has an operator too, but OpenVINO lacks it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, Final

import torch
from onnxscript import opset23
from torch import Tensor, nn
from torch.nn import functional as F
from torch.onnx import ops

from dior_rt.training.network import LARGEST_LOGIT, Block, Features, Mini, Rotation

OPSET: Final = 23
TINIEST: Final = 1e-24  # keeps a vector of zeros


def _log(x: Any) -> Any:
    """Return the logarithm as the log-sum of one number, which does not depend on the number of threads.

    ONNX Runtime computes Log in vectors, but the ends of each thread's share one by one, which may differ
    in the last bit.
    """
    last: Any = opset23.Constant(value_ints=[-1])
    return opset23.ReduceLogSum(opset23.Unsqueeze(x, last), last, keepdims=0)


def _log1p(x: Any) -> Any:
    one: Any = opset23.Constant(value_floats=[1.0])
    return _log(opset23.Add(x, one))


#: Replacements for the way torch's exporter writes some operations.
TRANSLATIONS: Final[dict[Callable, Callable]] = {
    torch.ops.aten.log.default: _log,
    torch.ops.aten.log1p.default: _log1p,
}


def fused(network: Mini) -> Mini:
    """Return a copy of the network whose `step` takes the output of `encode_fused`."""
    other: Any = copy.deepcopy(network)  # some of its modules are replaced
    config = network.config
    other.blocks = nn.ModuleList(FusedBlock(block) for block in other.blocks)
    weight = other.unembed.weight.T.reshape(config.width, config.quarter, *2 * (config.patch // 4,))
    other.divide_tokens = FusedDivideTokens(weight)
    for blend in (other.blend_quarter, other.blend_half):
        divide = blend.divide
        weight = divide.weight.reshape(-1, 2, 2, divide.in_channels).movedim(3, 0)
        blend.divide = Transposed(weight)
    assert isinstance(other, Mini)
    return other


def encode_fused(network: Mini, photo: Tensor, light: Tensor, mask: Tensor, own: Tensor) -> Features:
    """Return the network's features, including the biases of divided cells.

    Each of the finer cells has its own bias, but a transposed convolution has one bias for all of them.
    """
    features = network.encode(photo, light, mask, own)
    factor = network.config.patch // 4
    return features._replace(
        quarter=features.quarter + _tiled(network.unembed.bias, factor, features.tokens),
        half=features.half + _tiled(network.blend_quarter.divide.bias, 2, features.quarter),
        fine=features.fine + _tiled(network.blend_half.divide.bias, 2, features.half),
    )


class FusedBlock(Block):
    """A block in few operators. q, k and v are separate products, so nothing has to split them.

    A root mean square of 1 / sqrt(d) is a length of 1. The mean over all tokens keeps the bias of v
    unchanged, so the bias of `proj` includes it.
    """

    of_q: Tensor
    of_k: Tensor

    def __init__(self, block: Block) -> None:
        nn.Module.__init__(self)
        self.heads, self.offset = block.heads, block.offset
        self.up, self.down = block.up, block.down
        (q, k, v), (*biases, bias) = block.qkv.weight.chunk(3), block.qkv.bias.chunk(3)
        self.q, self.k, self.v = _linear(q, biases[0]), _linear(k, biases[1]), _linear(v, None)
        size = q.shape[1] // self.heads
        self.register_buffer("of_q", torch.full((size,), LARGEST_LOGIT / math.sqrt(size)))
        self.register_buffer("of_k", torch.full((size,), 1 / math.sqrt(size)))
        self.proj = _linear(block.proj.weight, block.proj.bias + block.proj.weight @ bias)

    def _attend(self, tokens: Tensor, turns: Rotation) -> Tensor:
        q, k = self._turned(self.q(tokens), self.of_q, turns), self._turned(self.k(tokens), self.of_k, turns)
        q, k, v = (part.unflatten(2, (self.heads, -1)) for part in (q, k, self.v(tokens)))  # (B, N, H, d)
        mixed = (q.transpose(1, 2) @ k.permute(0, 2, 3, 1)).softmax(dim=-1) @ v.transpose(1, 2)
        return self.proj(mixed.transpose(1, 2).flatten(2))

    def _turned(self, part: Tensor, weight: Tensor, turns: Rotation) -> Tensor:
        """Return every head's vectors, normalised and rotated, (B, N, width)."""
        heads = F.rms_norm(part.unflatten(2, (self.heads, -1)), weight.shape, weight, eps=TINIEST)
        return ops.rotary_embedding(heads.flatten(2), *turns, num_heads=self.heads)


class Transposed(nn.Module):
    """Divide each cell into factor x factor finer ones. weight: (from, to, factor, factor)."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.weight = nn.Parameter(weight.detach().clone().contiguous())

    def forward(self, cells: Tensor) -> Tensor:
        return F.conv_transpose2d(cells, self.weight, stride=self.weight.shape[2:])


class FusedDivideTokens(nn.Module):
    """Divide tokens into cells; the linear map is part of the weight."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.divide = Transposed(weight)

    def forward(self, tokens: Tensor, unembed: nn.Module) -> Tensor:
        return self.divide(tokens)


def _linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    linear = nn.Linear(weight.shape[1], weight.shape[0], bias is not None)
    linear.weight = nn.Parameter(weight.detach().clone())
    if bias is not None:
        linear.bias = nn.Parameter(bias.detach().clone())
    return linear


def _tiled(bias: Tensor | None, factor: int, coarse: Tensor) -> Tensor:
    """Return the biases (C * factor * factor,) for every finer cell of `coarse`, (C, h, w)."""
    assert bias is not None
    return bias.reshape(-1, factor, factor).repeat(1, *coarse.shape[2:])
