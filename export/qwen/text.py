"""Write the graphs of Qwen2.5-VL, which encodes a prompt and its pictures: one graph per layer.

    vision.embed       patches (P, 1176)                     -> x (P, V)
    vision.block.NN    x, cos, sin (P, d/2), groups (P,)     -> x           attention within equal groups
    vision.merge       x                                     -> features (P / 4, D)
    text.block.NN      x (T, D), cos, sin (T, d/2)           -> x           causal, grouped keys
    text.norm          x                                     -> x

The runtime sorts the patches into the order of the vision windows. It looks up the few embeddings that the
fixed prompts need, so the bundle does not contain the table of all words.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from transformers import Qwen2_5_VLConfig

from dior_rt.bundle import Graph
from dior_rt.errors import InputError
from dior_rt.export.qwen.graph import GraphWriter, Precision
from dior_rt.export.qwen.weights import Checkpoint

VISION_EPS = 1e-6  # from the model's code; its config does not contain it
OUT_OF_GROUP = -1e9  # added to a score, removes it


@dataclass(frozen=True)
class TextConfig:
    """The settings of the language model and the vision tower in text_encoder/config.json."""

    text: Any
    vision: Any

    @classmethod
    def read(cls, folder: Path) -> TextConfig:
        """Read the settings. Raises InputError if the folder describes no Qwen2.5-VL."""
        try:
            config: Any = Qwen2_5_VLConfig.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"{folder} describes no Qwen2.5-VL: {str(error).splitlines()[0]}") from error
        text, vision = config.text_config, config.vision_config
        if (
            "sliding_attention" in text.layer_types
            or text.hidden_act != "silu"
            or vision.hidden_act != "silu"
        ):
            raise InputError(f"{folder} uses a kind of layer that this export does not support.")
        return cls(text, vision)


def write_text_encoder(
    folder: Path, config: TextConfig, weights: Checkpoint, precision: Precision
) -> Iterator[tuple[str, Graph]]:
    """Write every graph into `folder`, yielding each when it is written."""
    yield "vision.embed", _write_vision_embed(folder / "vision.embed.onnx", config, weights)
    for index in range(config.vision.depth):
        name = f"vision.block.{index:02}"
        yield name, _write_vision_block(folder / f"{name}.onnx", config, weights, index, precision)
    yield "vision.merge", _write_vision_merge(folder / "vision.merge.onnx", config, weights)
    for index in range(config.text.num_hidden_layers):
        name = f"text.block.{index:02}"
        yield name, _write_text_block(folder / f"{name}.onnx", config, weights, index, precision)
    yield "text.norm", _write_text_norm(folder / "text.norm.onnx", config, weights)


def _write_vision_embed(path: Path, config: TextConfig, weights: Checkpoint) -> Graph:
    vision, kernel = config.vision, weights["visual.patch_embed.proj.weight"]
    with GraphWriter(path) as g:
        patches = g.input("patches", "patches", kernel[0].size)
        x = g.linear(patches, kernel.reshape(vision.hidden_size, -1), None)
        g.output("out", x, "patches", vision.hidden_size)
        return g.finish(path.stem)


def _write_vision_block(
    path: Path, config: TextConfig, weights: Checkpoint, index: int, precision: Precision
) -> Graph:
    vision, at = config.vision, f"visual.blocks.{index}."
    half_head = vision.hidden_size // vision.num_heads // 2
    with GraphWriter(path, precision) as g:
        x = g.input("x", "patches", vision.hidden_size)
        cos, sin = (g.input(name, "patches", half_head) for name in ("cos", "sin"))
        bias = _same_group(g, g.input("groups", "patches", dtype="int64"))
        normed = g.rms_norm(x, weights[f"{at}norm1.weight"], VISION_EPS)
        q, k, v = g.ops("Split", 3, _linear(g, normed, weights, f"{at}attn.qkv"), axis=1, num_outputs=3)
        q, k = (g.rotate(value, cos, sin, interleaved=False) for value in (q, k))
        mixed = g.attention(q, k, v, vision.num_heads, bias=bias)
        x = g.op("Add", x, _linear(g, mixed, weights, f"{at}attn.proj"))
        normed = g.rms_norm(x, weights[f"{at}norm2.weight"], VISION_EPS)
        x = g.op("Add", x, _gated(g, normed, weights, f"{at}mlp."))
        g.output("out", x, "patches", vision.hidden_size)
        return g.finish(path.stem)


def _write_vision_merge(path: Path, config: TextConfig, weights: Checkpoint) -> Graph:
    vision, at = config.vision, "visual.merger."
    with GraphWriter(path) as g:
        x = g.input("x", "patches", vision.hidden_size)
        x = g.rms_norm(x, weights[f"{at}ln_q.weight"], VISION_EPS)
        x = g.op("Reshape", x, g.ints(-1, vision.hidden_size * vision.spatial_merge_size**2))
        x = g.op("Gelu", _linear(g, x, weights, f"{at}mlp.0"), approximate="none")
        g.output("out", _linear(g, x, weights, f"{at}mlp.2"), "features", vision.out_hidden_size)
        return g.finish(path.stem)


def _write_text_block(
    path: Path, config: TextConfig, weights: Checkpoint, index: int, precision: Precision
) -> Graph:
    text, at = config.text, f"model.layers.{index}."
    heads, groups = text.num_attention_heads, text.num_key_value_heads
    head = text.hidden_size // heads
    with GraphWriter(path, precision) as g:
        x = g.input("x", "tokens", text.hidden_size)
        cos, sin = (g.input(name, "tokens", head // 2) for name in ("cos", "sin"))
        normed = g.rms_norm(x, weights[f"{at}input_layernorm.weight"], text.rms_norm_eps)
        q, k, v = (_linear(g, normed, weights, f"{at}self_attn.{role}_proj") for role in "qkv")
        q, k = (g.rotate(value, cos, sin, interleaved=False) for value in (q, k))
        k, v = (_repeat(g, value, groups, heads // groups) for value in (k, v))
        mixed = g.attention(q, k, v, heads, causal=True)
        x = g.op("Add", x, _linear(g, mixed, weights, f"{at}self_attn.o_proj", bias=False))
        normed = g.rms_norm(x, weights[f"{at}post_attention_layernorm.weight"], text.rms_norm_eps)
        x = g.op("Add", x, _gated(g, normed, weights, f"{at}mlp.", bias=False))
        g.output("out", x, "tokens", text.hidden_size)
        return g.finish(path.stem)


def _write_text_norm(path: Path, config: TextConfig, weights: Checkpoint) -> Graph:
    text = config.text
    with GraphWriter(path) as g:
        x = g.rms_norm(
            g.input("x", "tokens", text.hidden_size), weights["model.norm.weight"], text.rms_norm_eps
        )
        g.output("out", x, "tokens", text.hidden_size)
        return g.finish(path.stem)


def _gated(g: GraphWriter, x: str, weights: Checkpoint, at: str, bias: bool = True) -> str:
    """Append W_down (SiLU(W_gate x) * W_up x)."""
    gate, up = (_linear(g, x, weights, f"{at}{name}_proj", bias) for name in ("gate", "up"))
    gate = g.op("Mul", gate, g.op("Sigmoid", gate))
    return _linear(g, g.op("Mul", gate, up), weights, f"{at}down_proj", bias)


def _same_group(g: GraphWriter, groups: str) -> str:
    """Append the bias (1, 1, P, P) that restricts attention to patches of the same group."""
    same = g.op("Equal", g.op("Unsqueeze", groups, g.ints(1)), g.op("Unsqueeze", groups, g.ints(0)))
    bias = g.op("Where", same, g.scalar(0), g.scalar(OUT_OF_GROUP))
    return g.op("Unsqueeze", bias, g.ints(0, 1))


def _repeat(g: GraphWriter, x: str, groups: int, times: int) -> str:
    """Append (tokens, groups * head) with each head repeated `times` times."""
    split = g.op("Unsqueeze", g.op("Reshape", x, g.ints(0, groups, -1)), g.ints(2))
    return g.op("Reshape", g.op("Expand", split, g.ints(1, 1, times, 1)), g.ints(0, -1))


def _linear(g: GraphWriter, x: str, weights: Checkpoint, name: str, bias: bool = True) -> str:
    return g.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"] if bias else None)
