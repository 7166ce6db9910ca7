"""`python -m dior_rt.training.lumen`: pack views and train."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from dior_rt.errors import DiorError, InputError
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.fit import FitConfig, fit
from dior_rt.training.lumen.pack import LARGEST, rendered, write_shards

app = typer.Typer(no_args_is_help=True, help="Train lumen, the network that completes drawn light.")


@app.callback()
def main() -> None:
    """Train lumen, the network that completes drawn light."""


@app.command("pack")
def pack_command(
    renders: Annotated[Path, typer.Argument(help="Folder of rendered views.")],
    out: Annotated[Path, typer.Argument(help="Folder for the shards.")],
    shards: Annotated[int | None, typer.Option(help="At most this many shards.")] = None,
    largest: Annotated[float, typer.Option(help="Megabytes of a shard, at most.")] = LARGEST / 1e6,
) -> None:
    """Pack rendered views into a few files, some 25 KB a view; a mixed picture keeps about 40 dB."""
    try:
        paths = sorted(renders.glob("train-*-*.npz"))
        if not paths:
            raise InputError(
                f"There are no rendered views in {renders}; make some with `dior-rt train render`."
            )
        for path in write_shards(map(rendered, paths), out, int(largest * 1e6), shards, _count(len(paths))):
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    except DiorError as error:
        print(error)
        raise typer.Exit(2) from error


def _count(total: int) -> Callable[[int], None]:
    def progress(done: int) -> None:
        if done % 100 == 0 or done == total:
            print(f"{done}/{total} views", flush=True)

    return progress


@app.command("fit")
def fit_command(
    packs: Annotated[Path, typer.Argument(help="Folder of shards that `pack` wrote.")],
    out: Annotated[Path, typer.Argument(help="Folder for the checkpoint; a run in it goes on.")],
    minutes: Annotated[
        float | None, typer.Option(help="Train for this long; warm-up and decay follow.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Steps, where no minutes are given.")] = 1000,
    batch: Annotated[int, typer.Option(help="Samples a step.")] = 32,
    rate: Annotated[float, typer.Option(help="Largest learning rate.")] = 1e-3,
    backbone: Annotated[
        Path | None, typer.Option(help="ImageNet weights to start the features from.")
    ] = None,
    start: Annotated[Path | None, typer.Option(help="Checkpoint of another run to go on from.")] = None,
    surfaces: Annotated[
        Path | None, typer.Option(help="Folder of surface sheets, for new materials.")
    ] = None,
    precision: Annotated[str, typer.Option(help="auto, bf16 or fp32.")] = "auto",
    compiled: Annotated[bool, typer.Option(help="Compile the network: minutes once, then faster.")] = False,
    width: Annotated[int, typer.Option(help="Channels of a token.")] = 320,
    depth: Annotated[int, typer.Option(help="Transformer blocks of each of the two networks.")] = 6,
    heads: Annotated[int, typer.Option(help="Attention heads.")] = 5,
    seed: Annotated[int, typer.Option(help="Of the samples.")] = 0,
) -> None:
    """Train on packed views, by time or by steps. A run in OUT goes on where it stopped."""
    config = FitConfig(minutes, steps, batch, rate, seed=seed, precision=precision, compiled=compiled)
    sizes = LumenConfig(width=width, heads=heads, scene_depth=depth, light_depth=depth)
    begun = time.monotonic()

    def progress(step: int, done: float, errors: dict[str, float]) -> None:
        shown = " ".join(f"{name} {value:.4f}" for name, value in errors.items())
        print(f"{step:6d} {100 * done:5.1f}% {time.monotonic() - begun:6.1f} s  {shown}", flush=True)

    try:
        fit(packs, out, config, sizes, backbone, surfaces, start, progress)
    except DiorError as error:
        print(error)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app()
