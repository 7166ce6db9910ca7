"""How the commands lay out what they print."""

from __future__ import annotations

from collections.abc import Sequence

import typer


def table(rows: Sequence[tuple[str, object]]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")
