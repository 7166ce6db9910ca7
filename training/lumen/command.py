"""The commands that pack views and train lumen."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from dior_rt.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Train lumen, which reads the scene and completes drawn light.")


@app.command()
def pack(
    renders: Annotated[Path, typer.Argument(help="Folder of views rendered with Blender.")],
    out: Annotated[Path, typer.Argument(help="Folder for the shards.")],
    shards: Annotated[int | None, typer.Option(min=1, help="At most this many shards.")] = None,
    largest: Annotated[float, typer.Option(min=1, help="Megabytes of a shard, at most.")] = 55,
) -> None:
    """Pack rendered views into a few files, some 30 KB a view; a mixed picture keeps about 40 dB."""
    from dior_rt.training.lumen.pack import rendered, write_shards

    paths = sorted(renders.glob("train-*-*.npz"))
    if not paths:
        raise InputError(
            f"There are no rendered views in {renders}; `dior-rt train blender render` makes some."
        )
    for path in write_shards(map(rendered, paths), out, int(largest * 1e6), shards, _count(len(paths))):
        typer.echo(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def _count(total: int) -> Callable[[int], None]:
    def progress(done: int) -> None:
        if done % 100 == 0 or done == total:
            typer.echo(f"{done}/{total} views")

    return progress


@app.command()
def fit(
    packs: Annotated[Path, typer.Argument(help="Folder of shards that `pack` wrote.")],
    out: Annotated[Path, typer.Argument(help="Folder for the checkpoint; a run in it goes on.")],
    minutes: Annotated[
        float | None,
        typer.Option(min=0.1, help="Train for this long, loading and compiling included; the rate follows."),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Steps, where no minutes are given.")] = 1000,
    batch: Annotated[int, typer.Option(min=1, help="Samples a step.")] = 32,
    rate: Annotated[float, typer.Option(min=0, help="Largest learning rate.")] = 1e-3,
    backbone: Annotated[
        Path | None, typer.Option(help="ImageNet weights to start the features from.")
    ] = None,
    surfaces: Annotated[
        Path | None, typer.Option(help="Folder of surface sheets, for new materials.")
    ] = None,
    start: Annotated[Path | None, typer.Option(help="Checkpoint of another run to go on from.")] = None,
    precision: Annotated[
        Literal["auto", "bf16", "fp32"], typer.Option(help="auto: bf16 where the hardware multiplies in it.")
    ] = "auto",
    compiled: Annotated[bool, typer.Option("--compile", help="Compile the network first.")] = False,
    width: Annotated[int, typer.Option(min=8, help="Channels of a token.")] = 320,
    depth: Annotated[int, typer.Option(min=1, help="Transformer blocks of each of the two networks.")] = 6,
    heads: Annotated[int, typer.Option(min=1, help="Attention heads.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the samples.")] = 0,
) -> None:
    """Train on packed views, by time or by steps, on a GPU where there is one.

    \b
      dior-rt train lumen fit packs runs/lumen --minutes 8 --batch 256 --surfaces data/surfaces
      dior-rt train lumen fit packs runs/more --start runs/lumen --steps 20000
    """
    from dior_rt.training.lumen.config import LumenConfig
    from dior_rt.training.lumen.fit import FitConfig
    from dior_rt.training.lumen.fit import fit as train

    config = FitConfig(minutes, steps, batch, rate, seed=seed, precision=precision, compiled=compiled)
    sizes = LumenConfig(width=width, heads=heads, scene_depth=depth, light_depth=depth)
    begun = time.monotonic()

    def progress(step: int, done: float, errors: dict[str, float]) -> None:
        shown = " ".join(f"{name} {value:.4f}" for name, value in errors.items())
        typer.echo(f"{step:6d} {100 * done:5.1f}% {time.monotonic() - begun:6.1f} s  {shown}")

    train(packs, out, config, sizes, backbone, surfaces, start, progress)
