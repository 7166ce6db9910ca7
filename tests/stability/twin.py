"""The runtime in float64: light grids, light transfer, the sampler, the network's own graph.

Written from the equations in docs/contracts.md, docs/kernels.md and the modules' docstrings, and without
tables, bands, fast reciprocals of the compiler or fused operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from float64_reference import Array, decode, encode, reduce_photo, reduce_strokes, transfer
from numpy.typing import NDArray
from onnx import TensorProto, numpy_helper
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun

from dior_rt.bundle import Bundle
from dior_rt.families import Family
from dior_rt.families.mini import MODES, null
from dior_rt.flow.sampler import draw_noise
from dior_rt.kernels import Strokes

Velocity = Callable[[Array, float], Array]


def euler(velocity: Velocity, noise: NDArray, sigmas: NDArray) -> Array:
    """The end of the flow, one Euler step a sigma."""
    x = noise.astype(np.float64)
    for sigma, sigma_next in pairwise(sigmas.astype(np.float64).tolist()):
        x = x + (sigma_next - sigma) * velocity(x, sigma)
    return x


def shift_sigmas(shift: float, steps: int) -> Array:
    """s u / (1 + (s - 1) u), even in u."""
    u = np.arange(steps, -1, -1) / steps
    return shift * u / (1 + (shift - 1) * u)


class Graph:
    """An exported graph as ONNX's reference evaluator computes it, with every float a float64."""

    def __init__(self, path: Path) -> None:
        self._evaluator = ReferenceEvaluator(
            _in_float64(onnx.load(path)), new_ops=[RotaryEmbedding, MultiHeadAttention]
        )
        self._names = self._evaluator.input_names

    def run(self, feeds: Mapping[str, NDArray]) -> dict[str, Array]:
        wide = {
            n: feeds[n].astype(np.float64) if feeds[n].dtype.kind == "f" else feeds[n] for n in self._names
        }
        with np.errstate(over="ignore", invalid="ignore"):  # of its sigmoid, in the branch that is not taken
            return dict(zip(self._evaluator.output_names, self._evaluator.run(None, wide), strict=True))


class Network:
    """Mini's two graphs in float64."""

    def __init__(self, bundle: Bundle) -> None:
        self._encode, self._velocity = Graph(bundle.path("encode")), Graph(bundle.path("velocity"))

    def run(self, feeds: Mapping[str, NDArray]) -> Array:
        """The velocity for the inputs of one evaluation, with the photo's own light estimated first."""
        none = np.zeros_like(feeds["photo"])
        blank = self._encode.run({**feeds, "light": none, "mask": none[:, :1], "own": none})
        count = len(none)
        asked = {"x": none, "sigma": np.ones(count), "mode": np.full(count, MODES["estimate"])}
        own = (1 - self._velocity.run({**asked, **blank})["velocity"]) / 2
        return self._velocity.run({**feeds, **self._encode.run({**feeds, "own": own})})["velocity"]

    def velocity(self, condition: Mapping[str, NDArray], guidance: float) -> Velocity:
        """v_null + guidance (v_cond - v_null) of mini's graph."""
        without = null(condition)
        both = {name: np.concatenate([without[name], condition[name]]) for name in condition}

        def velocity(x: Array, sigma: float) -> Array:
            feeds = {"x": np.concatenate([x, x]), "sigma": np.full(2, sigma), **both}
            v_null, v_cond = np.split(self.run(feeds), 2)
            return v_null + guidance * (v_cond - v_null)

        return velocity


def relight_grid(
    family: Family[Any],
    network: Network,
    source: Array,
    strokes: Strokes,
    seed: int,
    steps: int,
    guidance: float,
    noise_scale: float = 1.0,
) -> Array:
    """The light grid `source` (h, w, 3) under strokes of its size, linear; seed draws the noise."""
    encoded = np.clip(encode(source), 0, 1).astype(np.float32)
    condition = family.encode(encoded, strokes, "relight")
    noise = noise_scale * draw_noise(seed, family.noise_shape(condition)).astype(np.float64)
    x0 = euler(network.velocity(condition, guidance), noise, family.sigmas(steps, condition))
    return decode(family.decode_relit(x0, condition))


def relight(
    family: Family[Any],
    network: Network,
    photo: NDArray,
    strokes: Strokes,
    seed: int,
    steps: int,
    guidance: float,
) -> Array:
    """The whole way of a picture: 0..1, not clipped."""
    grid = family.raster(*photo.shape[:2])
    source = np.minimum(reduce_photo(photo, grid), 1)  # the ratio at white serves brighter light as well
    light, mask = reduce_strokes(strokes.light, strokes.mask, grid)
    drawn = Strokes(light.astype(np.float32), mask.astype(np.float32))
    return transfer(photo, source, relight_grid(family, network, source, drawn, seed, steps, guidance))


def attention(q: Array, k: Array, v: Array) -> Array:
    """softmax(q k^T / sqrt(d)) v for (..., tokens, d), the largest logit of each row taken out."""
    logits = q @ np.swapaxes(k, -1, -2) / np.sqrt(q.shape[-1])
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return weights @ v / weights.sum(-1, keepdims=True)


class MultiHeadAttention(OpRun):
    """ONNX Runtime's, without bias: (B, tokens, heads * d) each."""

    op_domain = "com.microsoft"

    def _run(self, q: Array, k: Array, v: Array, num_heads: int = 1, unidirectional: int = 0) -> tuple[Array]:
        heads = (a.reshape(*a.shape[:2], num_heads, -1).swapaxes(1, 2) for a in (q, k, v))
        return (attention(*heads).swapaxes(1, 2).reshape(q.shape),)


class RotaryEmbedding(OpRun):
    """ONNX Runtime's, interleaved: the pairs (0, 1), (2, 3) ... of every head turn together."""

    op_domain = "com.microsoft"

    def _run(
        self, x: Array, _: NDArray, cos: Array, sin: Array, interleaved: int = 0, **defaults: int
    ) -> tuple[Array]:
        assert interleaved and not any(defaults.values())
        pairs = x.reshape(*x.shape[:2], -1, cos.shape[-1], 2)  # (B, tokens, heads, d / 2, 2)
        cos, sin = cos[:, None], sin[:, None]
        a, b = pairs[..., 0], pairs[..., 1]
        return (np.stack([a * cos - b * sin, a * sin + b * cos], -1).reshape(x.shape),)


def _in_float64(model: onnx.ModelProto) -> onnx.ModelProto:
    """The graph with its floats, weights and casts made float64."""
    narrow = (TensorProto.FLOAT, TensorProto.FLOAT16)

    def widen(tensor: TensorProto) -> None:
        if tensor.data_type in narrow:
            wide = numpy_helper.to_array(tensor).astype(np.float64)
            tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))

    for tensor in model.graph.initializer:
        widen(tensor)
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.TENSOR:
                widen(attribute.t)
            elif node.op_type == "Cast" and attribute.name == "to" and attribute.i in narrow:
                attribute.i = TensorProto.DOUBLE
    return model
