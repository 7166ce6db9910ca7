"""Find photos in files, folders with all their contents, patterns, and lists of names."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dior_rt.batch.match import is_drawing
from dior_rt.errors import InputError

#: The suffixes that are searched for in a folder. A file that is named is taken whatever its suffix.
SUFFIXES: Final = frozenset(
    (
        *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".gif", ".bmp", ".jp2", ".ppm", ".psd", ".exr"),
        *(".avif", ".heic", ".heif", ".jxl"),
        *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
    )
)
_MADE_HERE: Final = ("-relit", "-lumi")


@dataclass(frozen=True)
class Found:
    """A photo, and its place below the folder or pattern that found it. Its result gets the same place."""

    path: Path
    place: Path


def find_photos(inputs: Iterable[str], besides: Sequence[Path] = ()) -> list[Found]:
    """Find the photos that the inputs name, each once, in the order of the inputs and then of their names.

    inputs: files, folders (searched recursively; hidden files are left out) and patterns such as
    "day*/*.jpg". besides: files and folders to leave out, such as the results. Raises InputError for an input
    that does not exist.
    """
    left_out = [path.resolve() for path in besides]
    found: dict[Path, Found] = {}
    for text in inputs:
        for photo in _expand(text):
            real = photo.path.resolve()
            if not any(real == path or path in real.parents for path in left_out):
                found.setdefault(real, photo)
    return list(found.values())


def read_names(data: bytes) -> list[str]:
    """Return the names in a list: one per line, or separated by NUL as by `find -print0`.

    Raises InputError.
    """
    separator = b"\0" if b"\0" in data else b"\n"
    try:
        return [name.decode().rstrip("\r") for name in data.split(separator) if name.strip()]
    except UnicodeDecodeError:
        raise InputError("The list of photos on standard input is not UTF-8 text.") from None


def _expand(text: str) -> list[Found]:
    path = Path(text)
    if path.is_dir():
        return [
            Found(file, file.relative_to(path)) for file in sorted(path.rglob("*")) if _counts(file, path)
        ]
    if path.exists() or not glob.has_magic(text):
        if not path.exists():
            raise InputError(f"{text} is not there. Name photos, folders, or a pattern in quotes.")
        return [Found(path, Path(path.name))]
    root = _fixed_part(path)
    matches = [Path(name) for name in sorted(glob.glob(text, recursive=True))]  # noqa: PTH207 - may be absolute
    photos = [Found(file, file.relative_to(root)) for file in matches if file.is_file()]
    if not photos:
        raise InputError(f"No file fits the pattern {text}.")
    return photos


def _counts(file: Path, root: Path) -> bool:
    """Return whether a file in a folder is a photo to relight: not hidden, no strokes and no result."""
    return (
        file.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in file.relative_to(root).parts)
        and not is_drawing(file)
        and not file.stem.endswith(_MADE_HERE)
        and file.is_file()
    )


def _fixed_part(pattern: Path) -> Path:
    """Return the folders ahead of a pattern's first wildcard."""
    fixed = []
    for part in pattern.parts[:-1]:
        if glob.has_magic(part):
            break
        fixed.append(part)
    return Path(*fixed)
