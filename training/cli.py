"""`dior-rt train ...`: render scenes, train, add a LoRA, evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Render scenes and train the network (needs dior-rt[train]).")


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
