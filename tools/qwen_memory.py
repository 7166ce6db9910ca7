"""The memory that writing a transformer takes, against the number of its blocks.

    python -m tools.qwen_memory --blocks 2 --blocks 6 --blocks 12

Makes random checkpoints of a wide transformer with a LoRA on every block, and writes their graphs, each in a
process of its own whose peak is read at the end. What was there before, libraries above all, is taken off.
The peak is Linux's VmHWM: getrusage's would begin at that of the process that began this one.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, Final

import torch
import typer
from safetensors.torch import save_file

from dior_rt.export.qwen.graph import Precision
from dior_rt.export.qwen.lora import Lora
from dior_rt.export.qwen.transformer import TransformerConfig, write_transformer
from dior_rt.export.qwen.weights import Checkpoint, Merged
from tools.command import start

HEADS: Final = 4
HEAD: Final = 128
RANK: Final = 64


def peak(blocks: int, precision: Precision = "fp32") -> float:
    """Megabytes, at the peak, that writing the graphs of so many blocks adds to what a process takes."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make_model(folder, blocks)
        # A process begun afresh: a copy of this one would start from this one's own peak.
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=write, args=(folder, precision, sender))
        process.start()
        sender.close()
        found = receiver.recv()
        process.join()
    return float(found)


def make_model(folder: Path, blocks: int) -> None:
    """Write a random transformer in shards, and a LoRA for every block."""
    from diffusers import QwenImageTransformer2DModel  # which the process that is measured does without

    width = HEADS * HEAD
    model: Any = QwenImageTransformer2DModel(
        num_layers=blocks,
        num_attention_heads=HEADS,
        attention_head_dim=HEAD,
        joint_attention_dim=3584,
        zero_cond_t=True,
    )
    model.save_pretrained(folder / "model", max_shard_size="50MB")
    layers = [f"transformer_blocks.{index}.attn.to_q" for index in range(blocks)]
    down = {f"{layer}.lora_A.weight": torch.zeros(RANK, width) for layer in layers}
    up = {f"{layer}.lora_B.weight": torch.zeros(width, RANK) for layer in layers}
    save_file(down | up, folder / "lora.safetensors")


def write(folder: Path, precision: Precision, result: Connection) -> None:
    """Write the graphs, LoRA merged; send the growth of the process' peak."""
    config = TransformerConfig.read(folder / "model" / "config.json")
    weights = Merged(Checkpoint(folder / "model"), [Lora(folder / "lora.safetensors")])
    (folder / "out").mkdir()
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew, at what is held now
    before = held("VmHWM")
    for _ in write_transformer(folder / "out", config, weights, precision):
        pass
    result.send(held("VmHWM") - before)


def held(figure: str) -> float:
    """A figure of this process' memory, as /proc/self/status names it, in megabytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{figure}:")) * 1024 / 1e6


def main(
    blocks: Annotated[list[int] | None, typer.Option(help="May be repeated [default: 2 6 12].")] = None,
    precision: Annotated[Precision, typer.Option(help="Of the blocks.")] = "fp32",
) -> None:
    """Measure the memory that an export takes, against the number of blocks."""
    for count in blocks or (2, 6, 12):
        typer.echo(f"{count:3} blocks: {peak(count, precision):4.0f} MB")


if __name__ == "__main__":
    start(main)
