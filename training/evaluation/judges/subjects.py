"""Photos with marked places, and folders of photos, for judges to work on.

data/photos.json names each photo as `package:path`, of an installed package, or as a path in the repository.
Its places are pixels of the photo at `size`. A triple is a dab's centre on an object, a point inside the
object and one outside, across its border, both at the same distance from the dab.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np

from dior_rt.errors import InputError
from dior_rt.records import parse, read_json
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.metrics import Photo

MARKS: Final = Path(__file__).parent / "data" / "photos.json"
CLONE: Final = Path(__file__).resolve().parents[3]  # where the code is run from a clone of the repository
PICTURES: Final = (".jpg", ".jpeg", ".png")
OTHER_MAPS: Final = ("materials", "thumb")  # first words of the names of MultiIllum's other pictures
EXTRAS: Final = {"skimage": "scikit-image", "matplotlib": "matplotlib"}

Point = tuple[float, ...]  # (x, y) in pixels


@dataclass(frozen=True)
class Triple:
    """name: "object, what lies behind". dab, inside, outside: see the module."""

    name: str
    dab: Point
    inside: Point
    outside: Point


@dataclass(frozen=True)
class Marked:
    """A photo's name and marks. size: (width, height) of the marks. stroke: ends of a line on its subject."""

    photo: str
    size: tuple[int, ...]
    stroke: tuple[Point, ...]
    triples: tuple[Triple, ...]


@dataclass(frozen=True)
class Marks:
    photos: tuple[Marked, ...]


@dataclass(frozen=True)
class Subject:
    """A photo (H, W, 3), 8-bit sRGB, and its marks, or None."""

    name: str
    photo: Photo
    marks: Marked | None = None


def marked_photos(marks: Path = MARKS) -> list[Subject]:
    """Read the photos that have marks. Raises InputError where one is missing or has another size."""
    try:
        listed = parse(Marks, read_json(marks, 1 << 20)).photos
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the marks {marks}: {error}.") from error
    return [Subject(Path(item.photo.rpartition(":")[2]).stem, _read(item), item) for item in listed]


def folder_photos(folder: Path) -> list[Subject]:
    """Read the pictures of a folder and of the folders in it, except those of probes and materials."""
    paths = sorted(path for path in folder.rglob("*") if _is_photo(path))
    if not paths:
        raise InputError(f"There are no pictures in {folder}. Give a folder of photos, or the word photos.")
    return [Subject(path.stem, read_picture(path)) for path in paths]


def _is_photo(path: Path) -> bool:
    """Whether a file is a picture, and no probe or material map of the MultiIllum layout."""
    kind = path.stem.split("_")[0]
    return path.suffix.lower() in PICTURES and path.parent.name != "probes" and kind not in OTHER_MAPS


def find_photo(name: str) -> Path:
    """Return the file of a photo's name. Raises InputError with what to install or where to run."""
    package, _, inside = name.rpartition(":")
    if not package:
        path = CLONE / name
        if not path.is_file():
            raise InputError(f"{name} is missing. Run the judges in a clone of the repository.")
        return path
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise InputError(f"The photo {name} needs a package: pip install {EXTRAS.get(package, package)}.")
    path = Path(spec.submodule_search_locations[0]) / inside
    if not path.is_file():
        raise InputError(f"The package {package} does not hold the photo {inside}.")
    return path


def _read(item: Marked) -> Photo:
    photo = read_picture(find_photo(item.photo))
    if photo.shape[:2] != (item.size[1], item.size[0]):
        (height, width), (columns, rows) = photo.shape[:2], item.size
        raise InputError(f"{item.photo} has {width} x {height} pixels; its marks are for {columns} x {rows}.")
    return np.ascontiguousarray(photo)


def all_triples(subjects: Sequence[Subject]) -> list[tuple[Subject, Triple]]:
    """Return every triple with its photo."""
    return [(subject, triple) for subject in subjects if subject.marks for triple in subject.marks.triples]
