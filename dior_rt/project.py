"""Projects of the light desk: the lights that were drawn on one photo, in one file.

A `.dior` file is a zip that holds project.json: {"format": "dior project", "version": 1, "photo": {"name",
"sha256", "size": [width, height]}, "settings": {...}, "lights": [...]}. Positions are pixels of the photo as
it is seen. The photo itself is not in the file; its hash tells whether it is the one that was drawn on.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from dior_rt.drawing import Paint, Painter, Shape
from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.lights import Blend, Light
from dior_rt.records import loads, parse, unparse

FORMAT: Final = "dior project"
VERSION: Final = 1
SUFFIX: Final = ".dior"
ENTRY: Final = "project.json"

MOST_BYTES: Final = 64 << 20
MOST_LIGHTS: Final = 64
MOST_POINTS: Final = 2_000_000
FARTHEST: Final = 1e6  # pixels


@dataclass(frozen=True)
class PhotoRef:
    """The photo that was drawn on.

    size: [width, height]. sha256: the hash of its file, or empty where unknown.
    """

    size: tuple[int, ...]
    name: str = ""
    sha256: str = ""


@dataclass(frozen=True)
class Settings:
    """The settings of the result, see `Relighter.relight`. None: the model's default."""

    preset: str | None = None
    steps: int | None = None
    seed: int = 0
    intensity: float = 1.0


@dataclass(frozen=True)
class ShapeRecord:
    """A `Shape` with its `Paint`, as the file stores it."""

    kind: Literal["stroke", "fill", "gradient", "glow"]
    points: tuple[tuple[float, ...], ...]
    color: tuple[float, ...] = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    flow: float = 1.0
    softness: float = 0.5
    erase: bool = False
    width: float = 1.0
    pressure: tuple[float, ...] = ()
    thins: bool = False
    fades: bool = False


@dataclass(frozen=True)
class LightRecord:
    """A layer, as the file stores it: see `Light`. solo: where any layer is solo, only solo layers count."""

    name: str = ""
    blend: Blend = "add"
    on: bool = True
    solo: bool = False
    strength: float = 1.0
    tint: tuple[float, ...] = (1.0, 1.0, 1.0)
    reach: float | None = None
    shapes: tuple[ShapeRecord, ...] = ()


@dataclass(frozen=True)
class Project:
    """A project file. Two equal ones give the same picture."""

    photo: PhotoRef
    lights: tuple[LightRecord, ...] = ()
    settings: Settings = field(default_factory=Settings)
    format: str = FORMAT
    version: int = VERSION


def parse_project(document: Any) -> Project:
    """Return a project from parsed JSON. Raises ValueError, which names the place."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError("it is not a project of the light desk")
    if document.get("version") != VERSION:
        raise ValueError(
            f"its version is {document.get('version')!r:.20}; this program reads version {VERSION}"
        )
    project = parse(Project, document)
    if len(project.photo.size) != 2 or not min(project.photo.size) >= 1:
        raise ValueError("photo.size must be [width, height] in pixels")
    if len(project.lights) > MOST_LIGHTS:
        raise ValueError(f"it has more than {MOST_LIGHTS} lights")
    if sum(len(shape.points) for light in project.lights for shape in light.shapes) > MOST_POINTS:
        raise ValueError(f"its shapes have more than {MOST_POINTS} points")
    for i, light in enumerate(project.lights, 1):
        for j, shape in enumerate(light.shapes, 1):
            if problem := _problem(shape):
                raise ValueError(f"light {i}, shape {j}: {problem}")
    return project


def read_project(path: Path) -> Project:
    """Read a project file. Raises InputError for one that is damaged, or not a project."""
    check_readable(path, "project")
    try:
        return unpack(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the project {path}: {reason(error)}.") from error


def unpack(data: bytes) -> Project:
    """Return a project from the bytes of its file. Raises ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open(ENTRY) as entry:
            document = entry.read(MOST_BYTES + 1)
    except (zipfile.BadZipFile, KeyError, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise ValueError("it is damaged, or not a project of the light desk") from error
    except Exception as error:  # zlib.error and the errors of other compressions
        raise ValueError("it is damaged") from error
    if len(document) > MOST_BYTES:
        raise ValueError(f"it holds more than {MOST_BYTES >> 20} MiB")
    return parse_project(loads(document))


def pack(project: Project) -> bytes:
    """Return the bytes of a project's file. They are the same for equal projects."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        info = zipfile.ZipInfo(ENTRY, date_time=(1980, 1, 1, 0, 0, 0))
        info.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(info, json.dumps(unparse(project), separators=(",", ":")))
    return file.getvalue()


def write_project(path: Path, project: Project) -> None:
    """Write a project file whole or not at all. Raises InputError."""
    with replacing(path) as file:
        file.write(pack(project))


def hash_file(path: Path) -> str:
    """Return the sha256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def lights_of(project: Project, size: tuple[int, int], painter: Painter | None = None) -> list[Light]:
    """Return the lights that count, drawn for a photo of (rows, columns), the first at the bottom.

    Raises InputError where the photo's size differs from the project's, or a layer makes no sense.
    """
    if tuple(project.photo.size) != size[::-1]:
        width, height = project.photo.size
        raise InputError(
            f"The project was drawn on a photo of {width} x {height} pixels, and this one has "
            f"{size[1]} x {size[0]}. Use the photo that it was drawn on."
        )
    painter = painter or Painter(size, kept=len(project.lights) + 1)
    solo = any(light.solo for light in project.lights)
    return [
        Light(
            painter.draw(str(i), [_shape(shape) for shape in light.shapes]),
            light.blend,
            light.strength,
            _triple(light.tint),
            light.reach,
            light.on and (light.solo or not solo),
            light.name,
        )
        for i, light in enumerate(project.lights)
    ]


def _shape(record: ShapeRecord) -> Shape:
    paint = Paint(_triple(record.color), record.intensity, record.flow, record.softness, record.erase)
    points = tuple((p[0], p[1]) for p in record.points)
    return Shape(record.kind, points, paint, record.width, record.pressure, record.thins, record.fades)


def _triple(values: tuple[float, ...]) -> tuple[float, float, float]:
    if len(values) != 3:
        raise InputError(f"A colour must be three numbers, not {len(values)}.")
    return values[0], values[1], values[2]


_FEWEST_POINTS: Final = {"stroke": 1, "fill": 1, "gradient": 2, "glow": 3}


def _problem(shape: ShapeRecord) -> str | None:
    """Return what is wrong with a shape, or None."""
    if len(shape.points) < _FEWEST_POINTS[shape.kind]:
        return f"a {shape.kind} needs at least {_FEWEST_POINTS[shape.kind]} points"
    if not all(len(point) == 2 and max(map(abs, point)) <= FARTHEST for point in shape.points):
        return f"each point must be [x, y], within {FARTHEST:g} pixels"
    if shape.pressure and len(shape.pressure) != len(shape.points):
        return "it must have one pressure for each point, or none"
    if not all(0 <= p <= 1 for p in (*shape.pressure, shape.flow, shape.softness)):
        return "pressure, flow and softness must lie in 0..1"
    if len(shape.color) != 3 or not all(math.isfinite(c) and c >= 0 for c in (*shape.color, shape.intensity)):
        return "color must be three numbers of at least 0, and intensity one"
    if not 0 < shape.width <= FARTHEST:
        return f"its width must lie between 0 and {FARTHEST:g} pixels"
    return None
