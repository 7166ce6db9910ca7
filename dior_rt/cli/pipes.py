"""Read standard input and write standard output where `-` stands in place of a file's name."""

from __future__ import annotations

import functools
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dior_rt.errors import DiorError, InputError

STANDARD = Path("-")
MOST_BYTES = 4 << 30
_CHUNK = 1 << 20


def standard_files(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command read its `photo` or `strokes` from `-`, and write its `out` to `-`.

    The command sees temporary files, and its errors name standard input. A photo from standard input goes to
    standard output unless `out` says otherwise.
    """

    @functools.wraps(command)
    def piped(**arguments: Any) -> None:
        photo, strokes, out = arguments["photo"], arguments["strokes"], arguments["out"]
        if out is None and photo == STANDARD:
            out = arguments["out"] = STANDARD
        if STANDARD not in (photo, strokes, out):
            return command(**arguments)
        if photo == strokes:
            raise InputError("Only one of PHOTO and STROKES can come from standard input.")
        if out == STANDARD:
            _check_output(arguments)
        with tempfile.TemporaryDirectory(prefix="dior-rt-") as folder:
            names: dict[str, str] = {}
            for name in ("photo", "strokes"):
                if arguments[name] == STANDARD:
                    arguments[name] = _spool(Path(folder))
                    names[str(arguments[name])] = "from standard input"
            if out == STANDARD:
                arguments["out"] = Path(folder) / f"out.{arguments['format'] or 'png'}"
                names[str(arguments["out"])] = "standard output"
            try:
                command(**arguments)
            except DiorError as error:
                raise _renamed(error, names) from error
            if out == STANDARD:
                with arguments["out"].open("rb") as file:
                    shutil.copyfileobj(file, sys.stdout.buffer, _CHUNK)
                sys.stdout.buffer.flush()

    return piped


def _check_output(arguments: dict[str, Any]) -> None:
    if arguments["as_json"]:
        raise InputError("--json and the picture cannot both go to standard output; name a file with -o.")
    if sys.stdout.isatty():
        raise InputError("Standard output is a terminal. Send the picture to a file: -o OUT, or > OUT.")


def _spool(folder: Path) -> Path:
    """Copy standard input to a file whose suffix names its format."""
    if sys.stdin.isatty():
        raise InputError("Standard input is a terminal. Pipe a file into the command, or name one.")
    spool, length = folder / "in", 0
    with spool.open("wb") as file:
        while chunk := sys.stdin.buffer.read(_CHUNK):
            length += len(chunk)
            if length > MOST_BYTES:
                raise InputError(f"Standard input holds more than {MOST_BYTES >> 30} GiB.")
            file.write(chunk)
    with spool.open("rb") as file:
        suffix = suffix_of(file.read(64))
    return spool.rename(spool.with_suffix(suffix))


def suffix_of(head: bytes) -> str:
    """Return the suffix that fits a file's first bytes.

    All pictures get ".png" and are distinguished later.
    """
    signatures = {b"\x76\x2f\x31\x01": ".exr", b"\x93NUMPY": ".npy", b"PK\x03\x04": ".dior"}
    for signature, suffix in signatures.items():
        if head.startswith(signature):
            return suffix
    # Text may begin with a byte order mark, and in UTF-16 every other byte of ASCII text is 0.
    text = head.lstrip(b"\xef\xbb\xbf\xff\xfe\0 \t\r\n")
    return ".json" if text[:1] in (b"[", b"{") else ".png"


def _renamed(error: DiorError, names: dict[str, str]) -> DiorError:
    """Return the same error with the user's names in place of the temporary ones."""
    text = str(error)
    for name, shown in names.items():
        text = text.replace(name, shown)
    renamed = DiorError.__new__(type(error))
    renamed.args = (text,)
    return renamed
