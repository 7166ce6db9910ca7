"""One block of the released model's width, measured; and what follows from it for the whole model.

    python -m tools.qwen_blocks --side 512 --runs 3 --threads 2
    python -m tools.qwen_blocks --on-paper           (measure nothing)

Writes a block with random weights in each precision, runs it in ONNX Runtime and in torch on the same inputs,
in turn, and prints seconds, error and size. The projection multiplies: blocks x branches x steps for time,
blocks x bytes for memory. The figures for GPUs are arithmetic from their data sheets, not measurements.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated, Final

import numpy as np
import torch
import typer

from dior_rt.engine import Engine
from dior_rt.errors import InputError
from dior_rt.export.qwen.errors import block_inputs, empty_block, load_block, relative, run_block
from dior_rt.export.qwen.graph import PRECISIONS, Precision
from dior_rt.export.qwen.transformer import TransformerConfig, write_block
from dior_rt.export.qwen.weights import Array
from dior_rt.families.qwen.frame import fit_area
from tools.command import start

RELEASED: Final = TransformerConfig(
    in_channels=64,
    out_channels=16,
    num_layers=60,
    attention_head_dim=128,
    num_attention_heads=24,
    joint_attention_dim=3584,
    axes_dims_rope=(16, 56, 56),
    zero_cond_t=True,
)
WORDS: Final = 480  # a prompt of some 90 words, and two pictures of 14 x 14 features
STEPS: Final = 40
BRANCHES: Final = 2
USED: Final = 0.4  # of a GPU's peak, which large matrices reach in practice

FEW_STEPS: Final = 8  # of a few-step LoRA, which takes no guidance
LIVE: Final = (
    12  # streams that a block holds at most: MLP before and after its GELU 4 each, in fp16 2, x, LayerNorm
)


USUAL: Final[tuple[Precision, ...]] = ("fp32", "int8", "int4")


@dataclass(frozen=True)
class Gpu:
    """From the maker's data sheet: memory in GB, dense fp16 TFLOP/s with fp32 accumulation."""

    name: str
    memory: int
    tflops: float


GPUS: Final = (
    Gpu("NVIDIA RTX 4090", 24, 165.0),
    Gpu("NVIDIA A100 80 GB", 80, 312.0),
    Gpu("NVIDIA H100 SXM", 80, 989.0),
    Gpu("AMD MI300X", 192, 1307.0),
)


class RandomWeights:
    """Weights of the shapes that a block has, made when asked for; the same name, the same weights."""

    def __init__(self, config: TransformerConfig, index: int) -> None:
        block = empty_block(config)
        self._shapes = {
            f"transformer_blocks.{index}.{n}": tuple(w.shape) for n, w in block.state_dict().items()
        }

    @property
    def count(self) -> int:
        return sum(math.prod(shape) for shape in self._shapes.values())

    def shape(self, name: str) -> tuple[int, ...]:
        return self._shapes[name]

    def __getitem__(self, name: str) -> Array:
        shape = self._shapes[name]
        noise = np.random.default_rng(list(name.encode())).standard_normal(shape, dtype=np.float32)
        if len(shape) == 2:
            return noise / np.float32(math.sqrt(shape[1]))
        return noise * np.float32(0.02) + np.float32("norm" in name)


@dataclass(frozen=True)
class Measured:
    """A block in one precision: median seconds a run here and in torch, its error, bytes of its weights."""

    precision: Precision
    seconds: float
    torch_seconds: float
    error: float
    bytes: int


def measure(
    config: TransformerConfig,
    sizes: Sequence[tuple[int, int]],
    runs: int,
    threads: int | None,
    precisions: Sequence[Precision],
) -> list[Measured]:
    """Measure one block in each precision, its runs taking turns with torch's."""
    weights = RandomWeights(config, 0)
    block = load_block(config, weights, 0)
    feeds, inputs = block_inputs(config, block, seed=0, words=WORDS, sizes=tuple(sizes))
    before, want = np.concatenate([feeds["text"], feeds["image"]]), run_block(block, inputs)
    measured = []
    with tempfile.TemporaryDirectory() as scratch:
        for precision in precisions:
            path = Path(scratch) / f"{precision}.onnx"
            write_block(path, config, weights, 0, precision)
            engine = Engine(path, "cpu", threads)
            made = engine.run(feeds)
            got = np.concatenate([made["text_out"], made["image_out"]])
            here, torch_here = [], []
            for _ in range(runs):
                here.append(seconds(partial(engine.run, feeds)))
                torch_here.append(seconds(partial(run_block, block, inputs)))
            error = relative(got - before, want - before)
            size = path.with_suffix(".data").stat().st_size
            measured.append(Measured(precision, median(here), median(torch_here), error, size))
            path.with_suffix(".data").unlink()
    return measured


def seconds(run: Callable[[], object]) -> float:
    """How long one call takes."""
    start = perf_counter()
    run()
    return perf_counter() - start


def flops(config: TransformerConfig, image: int, text: int) -> float:
    """Floating point operations of one block, one branch: its matrix products and its attention."""
    width, tokens = config.width, image + text
    projections = 2 * tokens * (4 * width**2 + 8 * width**2)
    attention = 4 * tokens**2 * width
    return float(projections + attention)


def report(measured: Sequence[Measured], side: int) -> str:
    """The figures as text, with what they mean for the whole model here and, on paper, elsewhere."""
    tokens, weights = reference_tokens(side), RandomWeights(RELEASED, 0).count
    operations = flops(RELEASED, tokens, WORDS)
    lines = [
        f"one block: {weights / 1e6:.0f} M weights, {tokens} + {WORDS} tokens, {operations / 1e12:.2f} TFLOP",
        f"precision  seconds  in torch  error    weights  | 60 blocks  {STEPS} steps guided  {FEW_STEPS} not",
    ]
    for m in measured:
        size, whole = m.bytes / 1e9, RELEASED.num_layers * m.bytes / 1e9
        step = RELEASED.num_layers * m.seconds / 3600
        lines.append(
            f"{m.precision:9}  {m.seconds:7.2f}  {m.torch_seconds:8.2f}  {m.error:.1e}  {size:4.2f} GB"
            f"  | {whole:5.1f} GB  {step * STEPS * BRANCHES:13.1f} h  {step * FEW_STEPS:5.1f} h"
        )
    return "\n".join([*lines, *on_paper(512), *on_paper(1024)])


def on_paper(side: int) -> list[str]:
    """Seconds that pictures of side x side take in fp16, and whether a GPU's memory holds the blocks."""
    tokens = reference_tokens(side)
    total = flops(RELEASED, tokens, WORDS) * RELEASED.num_layers * STEPS * BRANCHES
    modulation = 12 * RELEASED.width * (RELEASED.width + 1)  # a table, not weights that stay
    blocks = 2e-9 * RELEASED.num_layers * (RandomWeights(RELEASED, 0).count - modulation)
    states = 4e-9 * LIVE * (tokens + WORDS) * RELEASED.width
    lines = [f"on paper, {side} x {side}, fp16: blocks {blocks:.1f} GB, states {states:.1f} GB"]
    for gpu in GPUS:
        seconds = total / (gpu.tflops * 1e12 * USED)
        short = blocks + states - gpu.memory
        held = f"{short:.1f} GB of the blocks are read anew at each step" if short > 0 else "all in memory"
        lines.append(f"  {gpu.name}, {gpu.memory} GB: {seconds:.0f} s at {USED:.0%} of its peak, {held}")
    return lines


def reference_tokens(side: int) -> int:
    """Tokens of a square picture that is painted, and of its two references."""
    rows, columns = fit_area(side**2, 1, 1, 32)
    return 3 * (rows // 16) * (columns // 16)


def main(
    side: Annotated[int, typer.Option(min=32, help="Of the picture and its references, in pixels.")] = 512,
    runs: Annotated[int, typer.Option(min=1, help="Runs of each precision.")] = 3,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads [default: all].")] = None,
    precision: Annotated[
        list[str] | None, typer.Option(help="May be repeated [default: fp32 int8 int4].")
    ] = None,
    only_paper: Annotated[bool, typer.Option("--on-paper", help="Measure nothing, only project.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write the figures there.")] = None,
) -> None:
    """Measure one block of the released model's width, and project the whole model from it."""
    if threads:
        torch.set_num_threads(threads)
    rows, columns = (length // 16 for length in fit_area(side**2, 1, 1, 32))
    if unknown := set(precision or ()) - set(PRECISIONS):
        raise InputError(f"There is no precision {min(unknown)!r}, only: {', '.join(PRECISIONS)}.")
    asked = [name for name in PRECISIONS if name in (precision or USUAL)]
    chosen: list[Precision] = [] if only_paper else asked
    measured = measure(RELEASED, [(rows, columns)] * 3, runs, threads, chosen) if chosen else []
    typer.echo(report(measured, side))
    if json_file:
        text = json.dumps([asdict(one) for one in measured], indent=2)
        json_file.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    start(main)
