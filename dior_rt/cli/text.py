"""Lay out what the commands print."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from dior_rt.errors import InputError
from dior_rt.files import reason


def say(text: str) -> None:
    """Print a result. Raises InputError where standard output accepts none, for example on a full disk."""
    try:
        typer.echo(text)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe; the command line's frame ends without a message
        raise
    except OSError as error:
        # Otherwise Python would fail once more at its end, when it flushes the buffer.
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.close(nothing)
        raise InputError(f"Cannot print the result: {reason(error)}.") from error


def table(rows: Sequence[tuple[str, object]]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name:<{width}}  {value}")
