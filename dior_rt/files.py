"""Writing a file all at once or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from dior_rt.errors import InputError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A binary file that takes its place at `path` when the block ends well, and else leaves nothing behind.

    Raises InputError, with the reason, where the folder cannot be written or the disk is full.
    """
    target = path.resolve()  # through a symbolic link, so that the link stays one
    draft = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}")
    try:
        try:
            # Not tempfile: its files are private to the user, ours gets the permissions of any new file.
            with draft.open("xb") as file:
                yield file
            draft.replace(target)
        except OSError as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error
    finally:
        with contextlib.suppress(OSError):
            draft.unlink()


def remove_drafts(path: Path) -> None:
    """Remove what `replacing(path)` left behind where its process was killed."""
    name = f".{path.name[:100]}."
    with contextlib.suppress(OSError):
        for draft in path.parent.iterdir():
            if draft.name.startswith(name) and re.fullmatch("[0-9a-f]{8}", draft.name[len(name) :]):
                draft.unlink()


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, unless it is there. Raises InputError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot make the folder {path}: {reason(error)}.") from error


def check_writable(path: Path) -> None:
    """Raise InputError now if `replacing(path)` would fail later, as far as can be known."""
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder; name a file")
        if path.exists() and not path.is_file():
            raise OSError("it is not a regular file")
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError("it is write-protected")
        if not path.resolve().parent.is_dir():
            raise NotADirectoryError(f"the folder {path.parent} does not exist")
        probe = path.resolve().with_name(f".{secrets.token_hex(8)}")
        probe.open("xb").close()
        probe.unlink()
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot write {path}: {reason(error)}.") from error


def check_free(path: Path, overwrite: bool) -> None:
    """Raise InputError where a file is there already, unless it may be replaced."""
    if path.exists() and not overwrite:
        raise InputError(f"{path} is there already. Give --overwrite to replace it, or name another file.")


def check_readable(path: Path, what: str) -> None:
    """Raise InputError unless `path` is a regular file that can be opened. what: "photo", "strokes" ..."""
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        if path.exists() and not path.is_file():
            raise OSError("it is not a regular file")
        path.open("rb").close()
    except FileNotFoundError as error:
        raise InputError(f"Cannot read the {what} {path}: there is no such file.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the {what} {path}: {reason(error)}.") from error


def reason(error: BaseException) -> str:
    """What a library's error says, as the end of a sentence: its first line, without a full stop."""
    text = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
    starts_as_a_sentence = text.partition(" ")[0][1:].islower()
    return (text[:1].lower() + text[1:] if starts_as_a_sentence else text).rstrip(".")
