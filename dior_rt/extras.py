"""Commands whose packages come with an extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dior_rt.errors import MissingExtraError


@contextmanager
def needs_extra(name: str, command: str | None = None) -> Iterator[None]:
    """Turn a package that is missing in the block into MissingExtraError.

    name: of the extra, and of the command unless that is given.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "dior_rt":  # ours is never missing but by mistake
            raise
        raise MissingExtraError(command or name, name) from error
