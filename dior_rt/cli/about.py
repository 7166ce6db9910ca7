"""The commands that tell what is there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dior_rt.cli import options


def info(
    bundle: Annotated[
        Path | None, typer.Argument(metavar="BUNDLE", help="[default: the model that ships with dior-rt]")
    ] = None,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Check a bundle's files and say what is in it.

    \b
      dior-rt info
      dior-rt info my-bundle --json
    """
    from dior_rt.bundle import default_bundle, read_bundle
    from dior_rt.records import unparse

    found = read_bundle(bundle or default_bundle())
    manifest = found.manifest
    if as_json:
        typer.echo(json.dumps({"folder": str(found.folder), **unparse(manifest)}, indent=2))
        return
    megabytes = sum((found.folder / file).stat().st_size for file in manifest.files) / 1e6
    rows = {
        "name": manifest.name,
        "folder": found.folder,
        "family": manifest.family,
        "licence": manifest.licence,
        "weights": f"{manifest.precision}, {megabytes:.1f} MB in {len(manifest.files)} files, all unaltered",
        "steps": manifest.steps,
        "guidance": f"{manifest.guidance:g}",
        "graphs": ", ".join(sorted(manifest.graphs)),
        **{f"parity {name}": f"{value:.4g}" for name, value in manifest.parity.items()},
    }
    _table(list(rows.items()))


def _table(rows: list[tuple[str, object]]) -> None:
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")
