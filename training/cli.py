"""`dior-rt train ...`: render scenes, train, add a LoRA, evaluate."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer(no_args_is_help=True, help="Render scenes and train the network (needs dior-rt[train]).")


Precision = Annotated[Literal["no", "bf16"], typer.Option(help="bf16 where the processor or GPU has it.")]


@app.callback()
def _group() -> None:
    """A callback keeps this a group of commands, however few they are."""


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise typer.BadParameter("write it as i/n with 0 <= i < n, for example 0/2")
    return int(index), int(count)


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder for the renders; what is there already is kept.")],
    scenes: Annotated[int, typer.Option(min=1, help="How many scenes, two views each.")] = 750,
    seed: Annotated[int, typer.Option(min=0, max=900, help="Sets of different seeds share no scene.")] = 0,
    shard: Annotated[str, typer.Option(help="i/n: this process's share; run one process a core.")] = "0/1",
) -> None:
    """Render random scenes, every light source alone, as pictures and as Lumi maps. Resumable."""
    from dior_rt.training.render import render_scenes

    share = _shard(shard)
    with typer.progressbar(length=len(range(share[0], scenes, share[1])), label="scenes") as bar:
        render_scenes(out, scenes, seed, share, lambda done, total: bar.update(1))


@app.command()
def fit(
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint; a run that stopped goes on from it.")],
    steps: Annotated[int, typer.Option(min=1)] = 4000,
    batch: Annotated[int, typer.Option(min=1)] = 32,
    rate: Annotated[float, typer.Option(min=0, help="Peak learning rate.")] = 8e-4,
    width: Annotated[int, typer.Option(min=8, help="Of a token; a multiple of 4 times the heads.")] = 256,
    depth: Annotated[int, typer.Option(min=1)] = 6,
    heads: Annotated[int, typer.Option(min=1)] = 8,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Train the network on renders. `accelerate launch -m dior_rt train fit ...` uses several GPUs."""
    from dior_rt.training.fit import Plan
    from dior_rt.training.fit import fit as run
    from dior_rt.training.network import Config

    plan = Plan(steps, batch, rate, seed=seed, precision=precision)
    with _Bar(steps) as bar:
        run(renders, out, Config(width, depth, heads), plan, bar.show)


@app.command()
def lora(
    base: Annotated[Path, typer.Argument(help="model.safetensors of a trained network.")],
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint: the base's weights and the LoRA.")],
    rank: Annotated[int, typer.Option(min=1)] = 32,
    steps: Annotated[int, typer.Option(min=1)] = 500,
    batch: Annotated[int, typer.Option(min=1)] = 32,
    rate: Annotated[float, typer.Option(min=0)] = 4e-4,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 1,
) -> None:
    """Train a LoRA on top of a network; `dior-rt export` merges it."""
    from dior_rt.training.fit import Plan, fit_lora

    plan = Plan(steps, batch, rate, warmup=50, seed=seed, precision=precision)
    with _Bar(steps) as bar:
        fit_lora(base, renders, out, rank, plan, bar.show)


@app.command(name="eval")
def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Folder of the bundle.")],
    renders: Annotated[Path, typer.Argument(help="Folder of renders that training has not seen.")],
    views: Annotated[int, typer.Option(min=1, help="How many views at most.")] = 80,
    steps: Annotated[int | None, typer.Option(min=1, help="Also with so many steps.")] = None,
    guidance: Annotated[float | None, typer.Option(min=0, help="Also with this guidance.")] = None,
    noise_scale: Annotated[float | None, typer.Option(min=0, help="Also from noise so strong.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of a table.")] = False,
) -> None:
    """Measure how well a bundle relights held-out renders, beside copying the source.

    With the bundle's own settings, and once more with those given.
    """
    from dior_rt.relight import Relighter
    from dior_rt.training.evaluate import Settings, evaluate, markdown
    from dior_rt.training.triplets import load_views

    relighter, held_out = Relighter(bundle), load_views(renders)[:views]
    asked = dict.fromkeys(
        [Settings(), Settings(steps, guidance, noise_scale)]
    )  # once where they are the same
    evaluations = [evaluate(relighter, held_out, settings) for settings in asked]
    if as_json:
        typer.echo(json.dumps([asdict(evaluation) for evaluation in evaluations], indent=2))
    else:
        typer.echo("\n\n".join(markdown(evaluation) for evaluation in evaluations))


class _Bar:
    """A progress bar on a terminal; elsewhere a line every hundred steps."""

    def __init__(self, steps: int) -> None:
        self.steps, self.began = steps, time.monotonic()

    def __enter__(self) -> _Bar:
        self.bar = (
            typer.progressbar(length=self.steps, label="steps").__enter__() if sys.stderr.isatty() else None
        )
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar:
            self.bar.render_finish()

    def show(self, step: int, loss: float) -> None:
        if self.bar:
            self.bar.label = f"loss {loss:.4f}"
            self.bar.update(step - self.bar.pos)
        elif step % 100 == 0 or step == self.steps:
            typer.echo(
                f"step {step}/{self.steps}  loss {loss:.4f}  {time.monotonic() - self.began:.0f} s", err=True
            )
