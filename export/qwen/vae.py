"""Write the graphs of AutoencoderKLQwenImage, a video autoencoder, for single pictures.

    encoder    pixels (1, 3, 8 h, 8 w) in -1..1    -> latents (1, z, h, w): the posterior's mean, normalised
    decoder    latents (1, z, h, w), normalised    -> pixels (1, 3, 8 h, 8 w), clipped to -1..1

Its convolutions also run over time, causally. The past of a picture is zeros, so only the last of the three
slices of each kernel meets non-zero values. Keeping that slice alone turns every 3-D convolution into a 2-D
one, with a third of the work and of the weights and the same result. The layers that change the frame rate
do not change the first frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diffusers.loaders.single_file_utils import convert_wan_vae_to_diffusers

from dior_rt.bundle import Graph
from dior_rt.errors import InputError
from dior_rt.export.qwen.graph import GraphWriter
from dior_rt.export.qwen.weights import Checkpoint, read_config


@dataclass(frozen=True)
class VaeConfig:
    """The settings in vae/config.json, with the names used there."""

    z_dim: int
    temperal_downsample: tuple[bool, ...]
    latents_mean: tuple[float, ...]
    latents_std: tuple[float, ...]

    @property
    def factor(self) -> int:
        """Return the pixels per latent in each direction."""
        return int(2 ** len(self.temperal_downsample))

    @classmethod
    def read(cls, path: Path) -> VaeConfig:
        """Read the settings. Raises InputError if the file describes no such autoencoder."""
        found = read_config(path)
        try:
            return cls(
                int(found["z_dim"]),
                *(tuple(found[n]) for n in list(cls.__dataclass_fields__)[1:]),  # type: ignore
            )
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} describes no AutoencoderKLQwenImage: {error}.") from error


def vae_names(keys: Iterable[str]) -> dict[str, str]:
    """Return the keys of an autoencoder's file -> diffusers' names. The keys of Wan, its origin, differ."""
    return {key: name for name, key in convert_wan_vae_to_diffusers({key: key for key in keys}).items()}


def write_encoder(path: Path, config: VaeConfig, weights: Checkpoint) -> Graph:
    with GraphWriter(path) as g:
        net = _Net(g, weights)
        x = net.conv(g.input("pixels", 1, 3, "height", "width"), "encoder.conv_in")
        for at in net.children("encoder.down_blocks"):
            x = net.block(x, at)
        x = net.head(net.middle(x, "encoder.mid_block"), "encoder")
        mean = g.ops("Split", 2, net.conv(x, "quant_conv"), axis=1, num_outputs=2)[0]
        x = g.op("Div", g.op("Sub", mean, _planes(g, config.latents_mean)), _planes(g, config.latents_std))
        g.output("latents", x, 1, config.z_dim, "rows", "columns")
        return g.finish("encoder")


def write_decoder(path: Path, config: VaeConfig, weights: Checkpoint) -> Graph:
    with GraphWriter(path) as g:
        net = _Net(g, weights)
        x = g.input("latents", 1, config.z_dim, "rows", "columns")
        x = g.op("Add", g.op("Mul", x, _planes(g, config.latents_std)), _planes(g, config.latents_mean))
        x = net.conv(net.conv(x, "post_quant_conv"), "decoder.conv_in")
        x = net.middle(x, "decoder.mid_block")
        for at in net.children("decoder.up_blocks"):
            for part in (*net.children(f"{at}.resnets"), *net.children(f"{at}.upsamplers")):
                x = net.block(x, part)
        x = g.op("Clip", net.head(x, "decoder"), g.scalar(-1), g.scalar(1))
        g.output("pixels", x, 1, 3, "height", "width")
        return g.finish("decoder")


class _Net:
    """The layers, by the names of their weights in the checkpoint. x is (1, channels, h, w)."""

    def __init__(self, g: GraphWriter, weights: Checkpoint) -> None:
        self.g, self.weights = g, weights

    def children(self, at: str) -> list[str]:
        """Return the numbered parts of `at`, in order."""
        numbers = {
            name[len(at) + 1 :].partition(".")[0] for name in self.weights.names if name.startswith(f"{at}.")
        }
        return [f"{at}.{number}" for number in sorted(numbers, key=int)]

    def block(self, x: str, at: str) -> str:
        if f"{at}.conv1.weight" in self.weights.names:
            return self.residual(x, at)
        if f"{at}.to_qkv.weight" in self.weights.names:
            return self.attention(x, at)
        if at.endswith(".upsamplers.0"):
            return self.conv(self.double(x), f"{at}.resample.1")
        return self.conv(x, f"{at}.resample.1", stride=2)

    def middle(self, x: str, at: str) -> str:
        return self.residual(
            self.attention(self.residual(x, f"{at}.resnets.0"), f"{at}.attentions.0"), f"{at}.resnets.1"
        )

    def head(self, x: str, at: str) -> str:
        return self.conv(self.silu(self.norm(x, f"{at}.norm_out")), f"{at}.conv_out")

    def residual(self, x: str, at: str) -> str:
        path = x
        for index in (1, 2):
            path = self.conv(self.silu(self.norm(path, f"{at}.norm{index}")), f"{at}.conv{index}")
        skip = (
            self.conv(x, f"{at}.conv_shortcut") if f"{at}.conv_shortcut.weight" in self.weights.names else x
        )
        return self.g.op("Add", path, skip)

    def attention(self, x: str, at: str) -> str:
        """Append self-attention with one head over all pixels."""
        g, channels = self.g, self.weights.shape(f"{at}.proj.weight")[0]
        qkv = g.op("Reshape", self.conv(self.norm(x, f"{at}.norm"), f"{at}.to_qkv"), g.ints(3 * channels, -1))
        q, k, v = g.ops("Split", 3, g.op("Transpose", qkv, perm=[1, 0]), axis=1, num_outputs=3)
        mixed = g.op("Transpose", g.attention(q, k, v, heads=1), perm=[1, 0])
        mixed = g.op("Reshape", mixed, g.op("Shape", x))
        return g.op("Add", x, self.conv(mixed, f"{at}.proj"))

    def norm(self, x: str, at: str) -> str:
        """Append x / |x| sqrt(channels) gamma over the channels."""
        g, gamma = self.g, self.weights[f"{at}.gamma"].reshape(-1, 1, 1)
        length = g.op("Max", g.op("ReduceL2", x, g.ints(1), keepdims=1), g.scalar(1e-12))
        return g.op("Mul", g.op("Div", x, length), g.constant(gamma * np.float32(len(gamma) ** 0.5)))

    def silu(self, x: str) -> str:
        return self.g.op("Mul", x, self.g.op("Sigmoid", x))

    def double(self, x: str) -> str:
        """Append x with each pixel doubled in both directions."""
        scales = self.g.constant(np.array([1, 1, 2, 2], np.float32))
        return self.g.op(
            "Resize",
            x,
            "",
            scales,
            mode="nearest",
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        )

    def conv(self, x: str, at: str, stride: int = 1) -> str:
        """Append a convolution that keeps the size, or halves it by a stride of 2 with padding at the far
        edges."""
        weight = self.weights[f"{at}.weight"]
        if weight.ndim == 5:
            weight = weight[:, :, -1]
        around = weight.shape[-1] // 2
        pads = [around] * 4 if stride == 1 else [0, 0, 1, 1]
        bias = self.g.constant(self.weights[f"{at}.bias"])
        return self.g.op("Conv", x, self.g.constant(weight), bias, pads=pads, strides=[stride, stride])


def _planes(g: GraphWriter, values: tuple[float, ...]) -> str:
    return g.constant(np.array(values, np.float32).reshape(-1, 1, 1))
