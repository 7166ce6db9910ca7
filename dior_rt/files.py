"""Write a file all at once or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from dior_rt.errors import InputError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a binary file that moves to `path` when the block succeeds, and is removed when it fails.

    Raises InputError, with the reason, where the folder cannot be written or the disk is full.
    """
    try:
        target = path.resolve()  # write through a symbolic link, so that the link remains a link
        # The draft gets a short name, because the target's may be as long as names can be. It is not made by
        # tempfile, whose files are private to the user: this file gets the permissions of any new file, or
        # of the file that it replaces.
        draft = target.with_name(f".{secrets.token_hex(8)}.part")
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"Cannot write {path}: {reason(error)}.") from error
    try:
        try:
            with draft.open("xb") as file:
                with contextlib.suppress(OSError):
                    draft.chmod(stat.S_IMODE(target.stat().st_mode))
                yield file
            draft.replace(target)
        except OSError as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error
    finally:
        with contextlib.suppress(OSError):
            draft.unlink()


def remove_drafts(folder: Path) -> None:
    """Remove the drafts of `replacing` in a folder where its process was killed."""
    with contextlib.suppress(OSError):
        for draft in folder.glob(".*.part"):
            if re.fullmatch(r"\.[0-9a-f]{16}\.part", draft.name):
                draft.unlink()


def make_folder(path: Path) -> None:
    """Make a folder and its parents unless they exist. Raises InputError where that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot make the folder {path}: {reason(error)}.") from error


def check_writable(path: Path) -> None:
    """Raise InputError now if `replacing(path)` would fail later, as far as that can be checked."""
    try:
        target = path.resolve()
        if not target.parent.is_dir():
            through = f", to which {path.name} links," if path.is_symlink() else ""
            raise NotADirectoryError(f"the folder {_shown(target, path)}{through} does not exist")
        with contextlib.suppress(FileNotFoundError):
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                raise IsADirectoryError("it is a folder; name a file")
            if not stat.S_ISREG(mode):
                raise OSError("it is not a regular file")
            if not os.access(path, os.W_OK):
                raise PermissionError("it is write-protected")
        probe = target.with_name(f".{secrets.token_hex(8)}")
        probe.open("xb").close()
        probe.unlink()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"Cannot write {path}: {reason(error)}.") from error


def check_free(path: Path, overwrite: bool) -> None:
    """Raise InputError where a file exists already, unless it may be replaced."""
    if not overwrite and is_there(path):
        raise InputError(f"{path} is there already. Give --overwrite to replace it, or name another file.")


def _shown(target: Path, path: Path) -> Path:
    return target.parent if path.is_symlink() else path.parent


def check_readable(path: Path, what: str) -> None:
    """Raise InputError unless `path` is a regular file that can be opened. what: "photo", "strokes" ..."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError("it is a folder")
        if not stat.S_ISREG(mode):
            raise OSError("it is not a regular file")
        path.open("rb").close()
    except FileNotFoundError as error:
        raise InputError(f"Cannot read the {what} {path}: there is no such file.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the {what} {path}: {reason(error)}.") from error


def is_there(path: Path) -> bool:
    """Return whether a path leads to something.

    Returns False for a path that cannot be followed; using it raises an error that says why.
    """
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def is_same_file(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file. False where one leads nowhere or cannot be followed."""
    try:
        return one.samefile(other)
    except (OSError, ValueError):
        return False


def reason(error: BaseException) -> str:
    """Return the message of a library's error, as the end of a sentence: its first line, without a full
    stop.
    """
    text = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
    starts_as_a_sentence = text.partition(" ")[0][1:].islower()
    return (text[:1].lower() + text[1:] if starts_as_a_sentence else text).rstrip(".")
