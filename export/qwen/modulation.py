"""Modulation: how sigma enters the transformer's blocks; a third of the model's weights.

    time        sigma (R,)     -> embedding (R, D)    SiLU(MLP(sinusoids of 1000 sigma))
    block.NN    embedding      -> rows (R, 12, D)     image, then text: shift, scale, gate, twice
    head        embedding      -> rows (R, 2, D)      scale, shift

None of it depends on the picture. So a bundle for one schedule holds the rows in a table (R, 12 layers + 2,
D) in place of these graphs. Everything is float32 in every precision.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from dior_rt.bundle import Graph
from dior_rt.engine import Engine
from dior_rt.export.qwen.graph import GraphWriter
from dior_rt.export.qwen.transformer import TransformerConfig
from dior_rt.export.qwen.weights import Array, Weights

WAVES = 256  # one half cosines, the other half sines
PERIOD = 10000.0


def write_modulation(
    folder: Path, config: TransformerConfig, weights: Weights
) -> Iterator[tuple[str, Graph]]:
    """Write the graphs into `folder`, yielding each when it is written."""
    yield "time", write_time(folder / "time.onnx", config, weights)
    for index in range(config.num_layers):
        name = f"block.{index:02}"
        at = f"transformer_blocks.{index}."
        layers = [f"{at}img_mod.1", f"{at}txt_mod.1"]
        yield name, write_rows(folder / f"{name}.onnx", config, weights, layers, 6)
    yield "head", write_rows(folder / "head.onnx", config, weights, ["norm_out.linear"], 2)


def write_time(path: Path, config: TransformerConfig, weights: Weights) -> Graph:
    with GraphWriter(path) as g:
        sigma = g.op("Unsqueeze", g.input("sigma", "rows"), g.ints(1))
        rates = 1000 * np.exp(-math.log(PERIOD) * np.arange(WAVES // 2) / (WAVES // 2))
        angles = g.op("Mul", sigma, g.constant(rates[None].astype(np.float32)))
        x = g.op("Concat", g.op("Cos", angles), g.op("Sin", angles), axis=1)
        for layer in ("linear_1", "linear_2"):
            name = f"time_text_embed.timestep_embedder.{layer}"
            x = _silu(g, g.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"]))
        g.output("embedding", x, "rows", config.width)
        return g.finish("time")


def write_rows(
    path: Path, config: TransformerConfig, weights: Weights, layers: Iterable[str], each: int
) -> Graph:
    """Append linear layers of the embedding, with `each` vectors per layer."""
    with GraphWriter(path) as g:
        embedding = g.input("embedding", "rows", config.width)
        made = [g.linear(embedding, weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in layers]
        rows = g.op("Reshape", g.op("Concat", *made, axis=1), g.ints(0, -1, config.width))
        g.output("rows", rows, "rows", each * len(made), config.width)
        return g.finish(path.stem)


def tabulate(
    path: Path, sigmas: Array, folder: Path, written: Iterable[tuple[str, Graph]], config: TransformerConfig
) -> None:
    """Write the table of rows for the sigmas. Each graph is written, run, and deleted."""
    shape = (len(sigmas), 12 * config.num_layers + 2, config.width)
    table = np.empty(shape, np.float32)  # a mapped file on a full disk would end the process
    embedding, start = sigmas, 0
    for name, graph in written:
        engine = Engine(folder / graph.file)
        if name == "time":
            embedding = engine.run({"sigma": sigmas})["embedding"]
        else:
            rows = engine.run({"embedding": embedding})["rows"]
            table[:, start : start + rows.shape[1]] = rows
            start += rows.shape[1]
        for file in (folder / graph.file, (folder / graph.file).with_suffix(".data")):
            file.unlink(missing_ok=True)
    np.save(path, table)


def _silu(g: GraphWriter, x: str) -> str:
    return g.op("Mul", x, g.op("Sigmoid", x))
