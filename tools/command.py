"""How every tool starts: a typer command whose known errors are one sentence and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NoReturn

import typer

from dior_rt.errors import DiorError


def start(main: Callable[..., None]) -> NoReturn:
    """Run a tool's command with the arguments of the command line."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(main)
    try:
        app()
    except (DiorError, OSError) as error:
        typer.echo(f"dior-rt: {error}", err=True)
    sys.exit(2)
