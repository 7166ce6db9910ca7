"""The commands of the data renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dior_rt.errors import MissingExtraError

app = typer.Typer(no_args_is_help=True, help="Render training views with Blender (needs dior-rt[render]).")


def parse_shard(text: str) -> tuple[int, int]:
    """Return the numbers of "i/n". Raises typer.BadParameter."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise typer.BadParameter("write it as i/n with 0 <= i < n, for example 0/2")
    return int(index), int(count)


@app.command()
def assets(
    out: Annotated[Path, typer.Option(help="Folder for the assets.")],
    data: Annotated[Path, typer.Option(help="Folder with surfaces/ and panoramas/.")],
    furniture: Annotated[
        Path, typer.Option(help="Folder with the .sh3f archives of Debian's sweethome3d-furniture.")
    ] = Path("/usr/share/sweethome3d/furniture"),
    people: Annotated[
        int, typer.Option(min=0, help="How many people to make (needs the package anny).")
    ] = 200,
) -> None:
    """Make the asset folder that scenes are built from."""
    from dior_rt.training.blender.collect import add_people, make_assets

    made = make_assets(out, furniture, data, lambda name: typer.echo(f"reading {name}"))
    if people:
        made = add_people(out, people)
    typer.echo(f"{len(made)} models in {out}")


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder for the views; what is there already is kept.")],
    assets: Annotated[Path, typer.Option(help="Asset folder.")],
    scenes: Annotated[int, typer.Option(min=1, help="How many scenes, up to two views each.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, max=900, help="Different seeds share no scene.")] = 0,
    shard: Annotated[str, typer.Option(help="i/n: this process's share; run one process a core.")] = "0/1",
    split: Annotated[Literal["train", "bench"], typer.Option(help="Which assets the scenes use.")] = "train",
    resolution: Annotated[int, typer.Option(min=16, help="Side in pixels.")] = 128,
    samples: Annotated[int, typer.Option(min=1, help="A pixel, shared by all lights.")] = 40,
) -> None:
    """Render scenes, every light alone, with their Lumi maps, normals, depth and albedo. Resumable."""
    try:
        import bpy  # noqa: F401

        from dior_rt.training.blender.cycles import ShootOptions
    except ImportError as error:
        raise MissingExtraError("train blender render", "render") from error
    from dior_rt.training.blender.views import Job, render_views

    job = Job(out, assets, scenes, seed, parse_shard(shard), split)
    options = ShootOptions(resolution, samples, samples)
    render_views(job, options, lambda done, total: typer.echo(f"{done}/{total} scenes"))
