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
from numpy.typing import NDArray
from onnx import TensorProto, numpy_helper
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun

from dior_rt.bundle import Bundle
from dior_rt.families import Family
from dior_rt.families.mini import MODES, null
from dior_rt.flow.sampler import draw_noise
from dior_rt.kernels import Strokes

Array = NDArray[np.float64]
Velocity = Callable[[Array, float], Array]

E, SIGMA = 0.02, 0.03


def decode(v: Any) -> Array:
    """sRGB -> linear light."""
    v = np.asarray(v, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4)


def encode(x: Any) -> Array:
    """Linear light -> sRGB."""
    x = np.asarray(x, np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def unit(picture: NDArray) -> Array:
    """Samples of any dtype -> 0..1."""
    return picture / (1.0 if picture.dtype.kind == "f" else float(np.iinfo(picture.dtype).max))


def overlaps(pixels: int, cells: int) -> Array:
    """(cells, pixels): how much of each pixel, 0..1, lies in each cell."""
    edges, pixel = np.arange(cells + 1)[:, None] * pixels / cells, np.arange(pixels)
    return np.clip(np.minimum(edges[1:], pixel + 1) - np.maximum(edges[:-1], pixel), 0, 1)


def light_of(picture: NDArray) -> Array:
    """sRGB samples of any dtype -> linear light."""
    if picture.dtype.kind == "f":
        return decode(picture)
    return decode(unit(np.arange(np.iinfo(picture.dtype).max + 1).astype(picture.dtype)))[picture]


def area_sum(values: Array, grid: tuple[int, int]) -> Array:
    """(H, W, C) -> (h, w, C): the sum over each cell's area."""
    down, across = overlaps(values.shape[0], grid[0]), overlaps(values.shape[1], grid[1])
    return np.einsum("jx,ixc->ijc", across, np.tensordot(down, values, 1))


def reduce_photo(photo: NDArray, grid: tuple[int, int]) -> Array:
    """The mean linear light of each cell; of many rows, some at a time."""
    (height, width), total = photo.shape[:2], np.zeros((grid[0], photo.shape[1], 3))
    down, across = overlaps(height, grid[0]), overlaps(width, grid[1])
    for top in range(0, height, 500):
        rows = slice(top, top + 500)
        total += np.tensordot(down[:, rows], light_of(photo[rows]), 1)
    return np.einsum("jx,ixc->ijc", across, total) * (grid[0] * grid[1] / (height * width))


def reduce_strokes(light: NDArray, mask: NDArray, grid: tuple[int, int]) -> tuple[Array, Array]:
    """(light, mask) of each cell; light is linear."""
    weight = mask.astype(np.float64)[..., None]
    light = np.where(weight > 0, light.astype(np.float64), 0)
    total, area = area_sum(light * weight, grid), area_sum(weight, grid)
    drawn = area[..., 0] > 1e-60
    return np.divide(total, area, out=np.zeros_like(total), where=drawn[..., None]), drawn


def transfer(
    photo: NDArray,
    source: Array,
    relit: Array,
    size: tuple[int, int] | None = None,
    corner: tuple[int, int] = (0, 0),
) -> Array:
    """The photo, 0..1 and not clipped, under the light that turns the grid `source` into `relit`.

    size, corner: where `photo` is part of a larger one, that one's (H, W) and the part's first pixel.
    """
    (height, width), (rows, columns) = size or photo.shape[:2], source.shape[:2]
    v = unit(photo)
    g, cell_g = _lightness(v), _lightness(encode(source))
    root = _sharpened(np.sqrt((relit + E) / (source + E)))
    y = ((corner[0] + np.arange(v.shape[0]) + 0.5) * rows / height - 0.5)[:, None]
    x = (corner[1] + np.arange(v.shape[1]) + 0.5) * columns / width - 0.5
    i, j = np.floor(y + 0.5).astype(int), np.floor(x + 0.5).astype(int)
    total, weights = np.zeros_like(v), np.zeros((*v.shape[:2], 1))
    for di, dj in np.ndindex(3, 3):
        near = i + di - 1, j + dj - 1
        cell = np.clip(near[0], 0, rows - 1), np.clip(near[1], 0, columns - 1)
        likeness = rough_reciprocal(1 + ((g - cell_g[cell]) / SIGMA) ** 2)
        weight = (_spline(y - near[0]) * _spline(x - near[1]) * likeness)[..., None]
        total += weight * root[cell]
        weights += weight
    light = light_of(photo)
    return encode((light + E) * (total / weights) ** 2 - E)


def rough_reciprocal(q: Array) -> Array:
    """1 / q with log2 and exp2 replaced by their chords between powers of two."""
    mantissa, exponent = np.frexp(q)
    log = 0x7EF311C7 / 2**23 - 254 - (exponent - 1 + 2 * mantissa - 1)
    return np.exp2(np.floor(log)) * (1 + log - np.floor(log))


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
    source = reduce_photo(photo, grid)
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


def _lightness(encoded: Array) -> Array:
    return np.clip(encoded @ [0.25, 0.5, 0.25], 0, 1)


def _sharpened(values: Array) -> Array:
    """The values plus what the spline will blur of them, within the range of the 3 x 3 neighbours."""
    rows, columns = values.shape[:2]
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.stack([padded[i : i + rows, j : j + columns] for i, j in np.ndindex(3, 3)])
    kernel = np.outer([1, 4, 1], [1, 4, 1]).ravel() / 36
    return np.clip(2 * values - np.tensordot(kernel, around, 1), around.min(0), around.max(0))


def _spline(d: Array) -> Array:
    d = np.abs(d)
    return np.where(d < 0.5, 0.75 - d * d, 0.5 * (1.5 - d) ** 2)
