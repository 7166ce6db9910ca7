"""Network: the shipped graph and a block of the qwen family, in three precisions.

The networks are compared with ONNX's reference evaluator in float64. The error of the velocity is relative to
the row's largest value, at least 1. The error of a block is relative to the norm of its output. fp16 and
int8 of mini are ONNX Runtime's own conversions of the full graph; those of qwen are this project's export.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import twin

from dior_rt.engine import Engine, Feeds
from dior_rt.export.qwen.graph import GraphWriter
from dior_rt.export.qwen.transformer import TransformerConfig, write_block
from dior_rt.families.qwen.rope import joint_places, turns

VELOCITY = {"fp32": 1e-5, "fp16": 2e-2, "int8": 2e-1}
BLOCK = {"fp32": 1e-5, "fp16": 3e-3, "int8": 6e-2}
ATTENTION = {"fp32": 1e-5, "fp16": 2e-3}
HALF = 65504.0  # the largest float16


ZEROS, ONES = np.zeros_like, np.ones_like
HOSTILE: dict[str, Callable[[Feeds], Feeds]] = {
    "usual": lambda f: f,
    "no strokes": lambda f: {**f, "mask": ZEROS(f["mask"]), "light": ZEROS(f["light"])},
    "light 1e4 everywhere": lambda f: {**f, "mask": ONES(f["mask"]), "light": 1e4 * ONES(f["light"])},
    "light 1e30 everywhere": lambda f: {**f, "mask": ONES(f["mask"]), "light": 1e30 * ONES(f["light"])},
    "light 1e-6": lambda f: {**f, "light": 1e-6 * f["light"]},
    "black photo, drawn darkness": lambda f: {
        **f,
        **{"photo": ZEROS(f["photo"]), "light": ZEROS(f["light"]), "mask": ONES(f["mask"])},
    },
    "clipped white photo": lambda f: {**f, "photo": ONES(f["photo"])},
    "all tokens equal": lambda f: {**f, **{name: ZEROS(f[name]) for name in ("x", "photo", "light", "mask")}},
    "state of 50": lambda f: {**f, "x": 50 * np.sign(f["x"])},
    "state at fp16's edge": lambda f: {**f, "x": HALF * np.sign(f["x"])},
    "state subnormal": lambda f: {**f, "x": 1e-40 * f["x"]},
}


@pytest.mark.parametrize("case", HOSTILE)
def test_velocity(velocity, network, usual_feeds, hold, case):
    usual = {name: array[[0, 3, 5, 9]] for name, array in usual_feeds.items()}
    feeds = {name: array.astype(usual[name].dtype) for name, array in HOSTILE[case](usual).items()}
    want = network.run(feeds)
    scale = np.maximum(np.abs(want).max((1, 2, 3), keepdims=True), 1)
    for precision, bound in VELOCITY.items():
        if precision == "fp16" and np.abs(want).max() > HALF:
            continue  # the answer itself is none that float16 can hold
        got = velocity(feeds, precision)
        hold(f"mini: {case}", precision, got, want, bound, "largest value", scale)


CONFIG = TransformerConfig(
    in_channels=16,
    out_channels=4,
    num_layers=1,
    attention_head_dim=16,
    num_attention_heads=3,
    joint_attention_dim=32,
    axes_dims_rope=(4, 6, 6),
    zero_cond_t=False,
)


def block_weights() -> dict[str, np.ndarray]:
    """Random weights of one block, by the names of diffusers' QwenImageTransformer2DModel."""
    random, width = np.random.default_rng(6), CONFIG.width
    layers = {f"attn.{name}": (width, width) for name in ("to_q", "to_k", "to_v", "to_out.0", "to_add_out")}
    layers |= {f"attn.add_{role}_proj": (width, width) for role in "qkv"}
    for stream in ("img", "txt"):
        layers[f"{stream}_mlp.net.0.proj"] = (4 * width, width)
        layers[f"{stream}_mlp.net.2"] = (width, 4 * width)
    weights = {}
    for name, (outputs, inputs) in layers.items():
        weights[f"{name}.weight"] = random.standard_normal((outputs, inputs)) / np.sqrt(inputs)
        weights[f"{name}.bias"] = 0.1 * random.standard_normal(outputs)
    for name in ("norm_q", "norm_k", "norm_added_q", "norm_added_k"):
        weights[f"attn.{name}.weight"] = 1 + 0.1 * random.standard_normal(CONFIG.attention_head_dim)
    return {f"transformer_blocks.0.{name}": value.astype(np.float32) for name, value in weights.items()}


def block_feeds(width: int, stream: float, modulation: float, distinct: float = 1) -> dict[str, np.ndarray]:
    """Inputs of a block: 5 words and 4 x 6 tokens, a residual stream and a modulation of some magnitude.

    distinct: 0 makes all tokens of a stream equal.
    """
    random = np.random.default_rng(7)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    def tokens(count: int) -> np.ndarray:
        return ((normal(1, width) + distinct * normal(count, width)) * stream).astype(np.float32)

    cos, sin = turns(joint_places(5, [(4, 6)]), (4, 6, 6), 10000.0)
    tables = {f"{name}_modulation": normal(6, width) * np.float32(modulation) for name in ("image", "text")}
    return {"image": tokens(24), "text": tokens(5), "cos": cos, "sin": sin, **tables}


BLOCKS = {
    "usual": {"stream": 1.0, "modulation": 1.0},
    "stream at fp16's edge": {"stream": HALF, "modulation": HALF},
    "stream beyond fp16": {"stream": 1e6, "modulation": 1.0},
    "activations beyond fp16": {"stream": 1.0, "modulation": 1e6},
    "silent modulation": {"stream": 1.0, "modulation": 0.0},
    "tokens all equal": {"stream": 1.0, "modulation": 1.0, "distinct": 0.0},
    "tokens all zero": {"stream": 0.0, "modulation": 1.0},
}


@pytest.mark.parametrize("case", BLOCKS)
def test_qwen_block(hold, tmp_path, case):
    feeds = block_feeds(CONFIG.width, **BLOCKS[case])
    for precision, bound in BLOCK.items():
        path = tmp_path / f"{precision}.onnx"
        write_block(path, CONFIG, block_weights(), 0, precision)
        if precision == "fp32":
            want = twin.Graph(path).run(feeds)
        got = Engine(path).run(feeds)
        for name in want:
            scale = np.linalg.norm(want[name]) / np.sqrt(want[name].size)
            rms = np.sqrt(np.mean((got[name] - want[name]) ** 2))
            hold(f"qwen block: {case}", precision, rms / scale, 0, bound, "norm")


def logits(case: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Queries, keys (multiples of 1/8, which float16 holds) and values (tokens, 2 heads * 16)."""
    random = np.random.default_rng(8)
    q, k = np.round(8 * random.standard_normal((2, 40, 32))) / 8
    v = random.standard_normal((40, 32))
    return tuple(
        a.astype(np.float32)
        for a in {
            "all logits equal": (0 * q, k, v),
            "logits of +-300": (8 * q, 8 * k, v),
            "logits of +-30,000": (64 * q, 64 * k, v),
            "all logits -5,000": (0 * q + 36, 0 * k - 36, v),
            "all logits 5,000": (0 * q + 36, 0 * k + 36, v),
            "values beyond fp16": (q, k, 1e7 * v),
            "values of 1e-12": (q, k, 1e-12 * v),
        }[case]
    )


@pytest.mark.parametrize("precision", ATTENTION)
@pytest.mark.parametrize(
    "case",
    [
        "all logits equal",
        "logits of +-300",
        "logits of +-30,000",
        "all logits -5,000",
        "all logits 5,000",
        "values beyond fp16",
        "values of 1e-12",
    ],
)
def test_attention(hold, tmp_path, precision, case):
    q, k, v = logits(case)
    with GraphWriter(tmp_path / "attention.onnx", precision) as g:
        g.output("y", g.attention(*(g.input(name, "tokens", 32) for name in "qkv"), heads=2), "tokens", 32)
        g.finish("attention")
    got = Engine(tmp_path / "attention.onnx").run({"q": q, "k": k, "v": v})["y"]
    heads = (a.astype(np.float64).reshape(40, 2, 16).swapaxes(0, 1) for a in (q, k, v))
    want = twin.attention(*heads).swapaxes(0, 1).reshape(40, 32)
    hold(f"attention: {case}", precision, got, want, ATTENTION[precision], "largest value", np.abs(v).max())


def test_equal_logits_mix_all_values_alike(tmp_path):
    """A known answer for the twin too: the mean."""
    q, k, v = logits("all logits equal")
    heads = (a.astype(np.float64).reshape(40, 2, 16).swapaxes(0, 1) for a in (q, k, v))
    want = np.broadcast_to(v.astype(np.float64).mean(0), (40, 32))
    np.testing.assert_allclose(twin.attention(*heads).swapaxes(0, 1).reshape(40, 32), want, atol=1e-14)
