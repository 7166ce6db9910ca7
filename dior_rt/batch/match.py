"""Match a photo with its strokes: beside it, in a folder of strokes, or one drawing for all.

The strokes of a.jpg are named a-light or a-strokes with any suffix below, or a with a suffix that no photo
has: a.json, a.npy, a.dior. In a folder that holds only strokes, a with any of the suffixes matches.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from dior_rt.errors import InputError

ENDINGS: Final = ("-light", "-strokes")
NO_PHOTO: Final = (".json", ".npy", ".dior")
SUFFIXES: Final = (*NO_PHOTO, ".png", ".exr", ".tif", ".tiff", ".webp", ".jpg", ".jpeg")


def is_drawing(path: Path) -> bool:
    """Return whether a file's name marks it as strokes."""
    return path.stem.endswith(ENDINGS) or path.suffix.lower() in NO_PHOTO


def find_strokes(photo: Path, place: Path, strokes: Path | None) -> Path:
    """Return the path of a photo's strokes. Raises InputError where there are none, or more than one.

    place: the photo's place below the folder in which it was found. strokes: a file for all photos; a folder,
    which is searched first by the layout of the photos' folder and then flat; or None for the photo's folder.
    """
    if strokes is not None and not strokes.is_dir():
        return strokes
    plain: tuple[str, ...]
    if strokes is None:
        folders, plain = [photo.parent], NO_PHOTO
    else:
        folders, plain = [strokes / place.parent, strokes], SUFFIXES
    names = [f"{photo.stem}{suffix}" for suffix in plain]
    names += [f"{photo.stem}{ending}{suffix}" for ending in ENDINGS for suffix in SUFFIXES]
    for folder in folders:
        found = [folder / name for name in names if (folder / name).is_file()]
        found = [path for path in found if not path.samefile(photo)]
        if len(found) > 1:
            raise InputError(f"It has two drawings, {found[0]} and {found[1]}. Move one of them away.")
        if found:
            return found[0]
    example = f"{photo.stem}.json or {photo.stem}-light.png"
    raise InputError(f"It has no strokes: there is no {example} in {folders[0]}.")
