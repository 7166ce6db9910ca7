"""Write the graphs of QwenImageTransformer2DModel, one per block, so that only one has to be in memory.

    embed       latents (I, C), text (T, J)                           -> image (I, D), text (T, D)
    block.NN    image, text, cos, sin (T + I, d/2), modulation         -> image, text
    head        image, modulation (2, D)                              -> velocity (I, C')

D = heads * d. The modulation of a block is 12 vectors: shift, scale and gate, twice, for the image and for
the text.
It depends on sigma alone, so it is not part of these graphs: see modulation.py.

With zero_cond_t (the 2511 model) the tokens of the reference pictures take the modulation of sigma = 0;
`lengths` holds how many tokens are being denoised, and how many follow them as references.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dior_rt.bundle import Graph
from dior_rt.errors import InputError
from dior_rt.export.qwen.graph import GraphWriter, Precision
from dior_rt.export.qwen.weights import Weights, read_config

EPS = 1e-6
THETA = 10000.0  # base of the rotary positions; the config does not contain it


@dataclass(frozen=True)
class TransformerConfig:
    """The settings in transformer/config.json, with the names used there."""

    in_channels: int
    out_channels: int
    num_layers: int
    attention_head_dim: int
    num_attention_heads: int
    joint_attention_dim: int
    axes_dims_rope: tuple[int, int, int]
    zero_cond_t: bool
    patch_size: int = 2

    @property
    def width(self) -> int:
        return self.num_attention_heads * self.attention_head_dim

    @classmethod
    def read(cls, path: Path) -> TransformerConfig:
        """Read the settings. Raises InputError for a model that this export does not support."""
        found = read_config(path)
        for name in ("guidance_embeds", "use_additional_t_cond", "use_layer3d_rope"):
            if found.get(name):
                raise InputError(f"{path} sets {name}, so it is not Qwen-Image-Edit.")
        try:
            fields = {
                name: found[name]
                for name in cls.__dataclass_fields__
                if name not in ("zero_cond_t", "patch_size")
            }
            fields["axes_dims_rope"] = tuple(fields["axes_dims_rope"])
            return cls(zero_cond_t=bool(found.get("zero_cond_t", False)), **fields)
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{path} describes no QwenImageTransformer2DModel: {error} is missing."
            ) from error


def write_transformer(
    folder: Path, config: TransformerConfig, weights: Weights, precision: Precision
) -> Iterator[tuple[str, Graph]]:
    """Write embed, blocks and head into `folder`, yielding each when written. Embed and head stay fp32."""
    yield "embed", write_embed(folder / "embed.onnx", config, weights)
    for index in range(config.num_layers):
        name = f"block.{index:02}"
        yield name, write_block(folder / f"{name}.onnx", config, weights, index, precision)
    yield "head", write_head(folder / "head.onnx", config, weights)


def write_embed(path: Path, config: TransformerConfig, weights: Weights) -> Graph:
    with GraphWriter(path) as g:
        latents = g.input("latents", "image_tokens", config.in_channels)
        text = g.input("text", "text_tokens", config.joint_attention_dim)
        text = g.rms_norm(text, weights["txt_norm.weight"], EPS)
        g.output("image_out", _linear(g, latents, weights, "img_in"), "image_tokens", config.width)
        g.output("text_out", _linear(g, text, weights, "txt_in"), "text_tokens", config.width)
        return g.finish("embed")


def write_head(path: Path, config: TransformerConfig, weights: Weights) -> Graph:
    with GraphWriter(path) as g:
        image = g.input("image", "image_tokens", config.width)
        scale, shift = g.ops("Split", 2, g.input("modulation", 2, config.width), axis=0, num_outputs=2)
        image = modulated(g, image, scale, shift, config.width)
        channels = config.patch_size**2 * config.out_channels
        g.output("velocity", _linear(g, image, weights, "proj_out"), "image_tokens", channels)
        return g.finish("head")


def write_block(
    path: Path, config: TransformerConfig, weights: Weights, index: int, precision: Precision
) -> Graph:
    """Write one QwenImageTransformerBlock with QwenDoubleStreamAttnProcessor2_0, in real numbers."""
    width, at = config.width, f"transformer_blocks.{index}."
    with GraphWriter(path, precision) as g:
        image = g.input("image", "image_tokens", width)
        text = g.input("text", "text_tokens", width)
        cos = g.input("cos", "tokens", config.attention_head_dim // 2)
        sin = g.input("sin", "tokens", config.attention_head_dim // 2)
        mods = {
            "img": _image_modulation(g, config),
            "txt": Modulation(g, [g.input("text_modulation", 6, width)]),
        }

        streams = {"txt": text, "img": image}
        normed = {name: mods[name].norm(x, 0, width) for name, x in streams.items()}
        mixed = _attend(g, config, weights, at + "attn.", normed, cos, sin)
        for name, gain in mixed.items():
            x = g.op("Add", streams[name], mods[name].gate(gain, 0))
            hidden = _linear(g, mods[name].norm(x, 1, width), weights, f"{at}{name}_mlp.net.0.proj")
            hidden = _linear(g, g.op("Gelu", hidden, approximate="tanh"), weights, f"{at}{name}_mlp.net.2")
            streams[name] = g.op("Add", x, mods[name].gate(hidden, 1))
        g.output("image_out", streams["img"], "image_tokens", width)
        g.output("text_out", streams["txt"], "text_tokens", width)
        return g.finish(f"block.{index:02}")


def _attend(
    g: GraphWriter,
    config: TransformerConfig,
    weights: Weights,
    at: str,
    normed: dict[str, str],
    cos: str,
    sin: str,
) -> dict[str, str]:
    """Append joint attention of text and image tokens, in that order. Return what it adds to each."""
    heads = config.num_attention_heads
    layers = {"txt": ("add_{}_proj", "norm_added_{}", "to_add_out"), "img": ("to_{}", "norm_{}", "to_out.0")}

    def joint(role: str) -> str:
        parts = []
        for name, (project, norm, _) in layers.items():
            part = _linear(g, normed[name], weights, at + project.format(role))
            if role != "v":
                part = g.head_norm(part, heads, weights[f"{at}{norm.format(role)}.weight"], EPS)
            parts.append(part)
        whole = g.op("Concat", *parts, axis=0)
        return whole if role == "v" else g.rotate(whole, cos, sin, interleaved=True)

    mixed = g.attention(joint("q"), joint("k"), joint("v"), heads)
    lengths = [g.op("Shape", normed[name], start=0, end=1) for name in ("txt", "img")]
    parts = g.ops("Split", 2, mixed, g.op("Concat", *lengths, axis=0), axis=0)
    return {
        name: _linear(g, part, weights, at + out)
        for part, (name, (_, _, out)) in zip(parts, layers.items(), strict=True)
    }


class Modulation:
    """Shift, scale and gate of a block's two halves, from tables (6, D): one, or one for each part of x."""

    def __init__(self, g: GraphWriter, tables: list[str], lengths: str = "") -> None:
        self._g, self._lengths = g, lengths
        self._rows = [g.ops("Split", 6, table, axis=0, num_outputs=6) for table in tables]

    def norm(self, x: str, half: int, width: int) -> str:
        """Append LayerNorm(x) (1 + scale) + shift."""
        return self._each(
            x, lambda part, rows: modulated(self._g, part, rows[3 * half + 1], rows[3 * half], width)
        )

    def gate(self, x: str, half: int) -> str:
        return self._each(x, lambda part, rows: self._g.op("Mul", part, rows[3 * half + 2]))

    def _each(self, x: str, change: Callable[[str, list[str]], str]) -> str:
        if len(self._rows) == 1:
            return change(x, self._rows[0])
        parts = self._g.ops("Split", len(self._rows), x, self._lengths, axis=0)
        changed = [change(part, rows) for part, rows in zip(parts, self._rows, strict=True)]
        return self._g.op("Concat", *changed, axis=0)


def modulated(g: GraphWriter, x: str, scale: str, shift: str, width: int) -> str:
    """Append LayerNorm(x) (1 + scale) + shift, for one scale and one shift."""
    grown = g.op("Mul", g.layer_norm(x, width, EPS), g.op("Add", scale, g.scalar(1)))
    return g.op("Add", grown, shift)


def _image_modulation(g: GraphWriter, config: TransformerConfig) -> Modulation:
    if not config.zero_cond_t:
        return Modulation(g, [g.input("image_modulation", 6, config.width)])
    tables = g.ops("Split", 2, g.input("image_modulation", 2, 6, config.width), axis=0, num_outputs=2)
    lengths = g.input("lengths", 2, dtype="int64")
    return Modulation(g, [g.op("Squeeze", table, g.ints(0)) for table in tables], lengths)


def _linear(g: GraphWriter, x: str, weights: Weights, name: str) -> str:
    return g.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])
