"""Report the missing packages of an extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dior_rt.errors import MissingExtraError


@contextmanager
def needs_extra(name: str, command: str | None = None) -> Iterator[None]:
    """Turn a missing package in the block into MissingExtraError.

    name: the name of the extra, and of the command where no other is passed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "dior_rt":  # a bug, not a missing extra
            raise
        raise MissingExtraError(command or name, name) from error
