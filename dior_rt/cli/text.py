"""How the commands lay out what they print."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from dior_rt.errors import InputError
from dior_rt.files import reason


def say(text: str) -> None:
    """Print a result. Raises InputError where standard output takes none, for example on a full disk."""
    try:
        typer.echo(text)
        sys.stdout.flush()
    except BrokenPipeError:  # who reads it has seen enough; the command line's frame ends quietly
        raise
    except OSError as error:
        # What is still in the buffer would fail once more when Python ends.
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.close(nothing)
        raise InputError(f"Cannot print the result: {reason(error)}.") from error


def table(rows: Sequence[tuple[str, object]]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name:<{width}}  {value}")
