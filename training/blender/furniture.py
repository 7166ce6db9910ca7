"""Convert the models of Debian's package sweethome3d-furniture for the asset folder.

A catalogue is a folder (or .sh3f archive, a zip) with PluginFurnitureCatalog.properties and OBJ models.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.files import reason
from dior_rt.training.blender.assets import Entry
from dior_rt.training.blender.meshes import Finish, Mesh

CATALOGUE: Final = "PluginFurnitureCatalog.properties"
LARGEST_FILE: Final = 3_000_000  # bytes of an OBJ file
LARGEST_MESH: Final = 60_000  # triangles
TEXTURE_SIDE: Final = 256
DARKEST: Final = 0.02  # light does not show on a lower reflectance
# Excluded: flat markings, plugs, holes in the ground, and parts of buildings that need a wall around them.
LEFT_OUT: Final = re.compile(
    r"pool|jacuzzi|sandpit|plug|switch|socket|arrow|parking|crossing|rails|escalator|elevator|door|window|"
    r"chimney|staircase|smoke detector|antenna|bill |shower|blind|drop",
    re.I,
)
ANIMALS: Final = re.compile(r"\b(cat|dog|horse|chicken|deer|rabbit|bulldog|siamese cat)\b", re.I)
PLANTS: Final = re.compile(
    r"tree|bush|hedge|palm|pine|maple|bamboo|acacia|poplar|cypress|beech|sycamore|peach blossom", re.I
)


class Catalogue:
    """The files of a catalogue, in a folder or an archive."""

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        self._folder = None if path.is_file() else path
        self._archive = zipfile.ZipFile(path) if path.is_file() else None
        names = self._archive.namelist() if self._archive else []
        self._names = {name.lower(): name for name in names}

    def read(self, name: str) -> bytes:
        """Return a file's bytes. Raises KeyError or OSError where the file does not exist."""
        name = name.lstrip("/")
        if self._folder:
            return (self._folder / name).read_bytes()
        assert self._archive
        return self._archive.read(self._names[name.lower()])

    def items(self) -> Iterator[tuple[int, dict[str, str]]]:
        """Yield the catalogue's models: number and properties."""
        text = self.read(CATALOGUE).decode("latin1")
        found: dict[int, dict[str, str]] = {}
        for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.M):
            found.setdefault(int(number), {})[key] = value.strip().replace("\\:", ":")
        yield from sorted(found.items())


def find_catalogues(folder: Path) -> list[Catalogue]:
    """Return the catalogues in a folder: .sh3f archives, or folders of unzipped ones. Raises InputError."""
    try:
        archives = [Catalogue(path) for path in sorted(folder.glob("*.sh3f"))]
        found = archives or [Catalogue(path.parent) for path in sorted(folder.glob(f"*/{CATALOGUE}"))]
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"Cannot read the furniture in {folder}: {reason(error)}.") from error
    if not found:
        raise InputError(f"{folder} holds no furniture: no .sh3f archive and no folder of one.")
    return found


@dataclass(frozen=True)
class Model:
    """An entry of a catalogue, and its mesh."""

    entry: Entry
    mesh: Mesh


def models(catalogue: Catalogue) -> Iterator[Model]:
    """Yield the catalogue's models that scenes can use.

    Models that are too large or not readable are left out.
    """
    for number, properties in catalogue.items():
        described = _entry(catalogue, number, properties)
        if described is None:
            continue
        try:
            mesh = _read_mesh(catalogue, properties["model"])
        except (KeyError, OSError, ValueError, IndexError):
            continue
        if 0 < len(mesh.faces) <= LARGEST_MESH:
            turned = _turned(mesh, properties.get("modelRotation"))
            yield Model(described, _fitted(turned, described.size))


def _entry(catalogue: Catalogue, number: int, properties: dict[str, str]) -> Entry | None:
    try:
        width, depth, height = (float(properties[key]) / 100 for key in ("width", "depth", "height"))
    except (KeyError, ValueError):
        return None
    name = properties.get("name", "")
    category = properties.get("category", "")
    unwanted = properties.get("doorOrWindow") == "true" or category in ("Doors and windows", "Staircases")
    if unwanted or LEFT_OUT.search(name) or max(width, depth, height) > 14 or "model" not in properties:
        return None
    size, elevation = (width, depth, height), float(properties.get("elevation", 0)) / 100
    if sorted(size)[1] < 0.008 or sorted(size)[2] < 0.04:
        return None
    top = float(properties.get("dropOnTopElevation", height * 100)) / 100
    return Entry(
        file=f"models/{catalogue.name}-{number:03d}.npz",
        name=name,
        size=size,
        elevation=elevation,
        top=max(top, 0.0),
        place=_place(name, category, size, elevation),
        author=properties.get("creator", ""),
        licence="CC0 1.0" if "CC-0" in catalogue.name else "CC BY 3.0",
    )


def _place(name: str, category: str, size: tuple[float, float, float], elevation: float) -> str:
    if category == "Characters" or re.search("mannequin", name, re.I):
        return "person"
    if ANIMALS.search(name):
        return "animal"
    if category == "Vehicles":
        return "vehicle"
    if category == "Exterior" or PLANTS.search(name):
        return "outdoor" if max(size) > 0.45 else "small"
    if elevation > 0.3:
        return "wall"
    return "floor" if max(size) > 0.5 else "small"


def _read_mesh(catalogue: Catalogue, path: str) -> Mesh:
    data = catalogue.read(path)
    if len(data) > LARGEST_FILE:
        raise ValueError("too large")
    folder = PurePosixPath(path).parent
    vertices: list[list[str]] = []
    texels: list[list[str]] = []
    corners: list[tuple[str, str, str]] = []
    slots: list[int] = []
    names: dict[str, int] = {}
    finishes: dict[str, Finish] = {}
    slot = names.setdefault("", 0)
    for line in data.decode("latin1").splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append(rest[:3])
        elif kind == "vt":
            texels.append(rest[:2])
        elif kind == "usemtl":
            slot = names.setdefault(" ".join(rest), len(names))
        elif kind == "mtllib":
            finishes |= _read_finishes(catalogue, folder / " ".join(rest))
        elif kind == "f":
            fan = [(rest[0], rest[k], rest[k + 1]) for k in range(1, len(rest) - 1)]
            corners += fan
            slots += [slot] * len(fan)
    at = np.array(vertices, float)
    pairs = [[[*corner.split("/"), "", ""][:2] for corner in face] for face in corners]
    faces = _indices([[corner[0] for corner in face] for face in pairs], len(at))
    uv = None
    if texels and all(corner[1] for face in pairs for corner in face):
        grid = np.array(texels, float)
        uv = grid[_indices([[corner[1] for corner in face] for face in pairs], len(grid))]
    used = [finishes.get(name, Finish()) for name in names]
    upright = np.stack([at[:, 0], -at[:, 2], at[:, 1]], 1)
    return Mesh(upright.astype(np.float32), faces, uv, np.array(slots, np.int32), tuple(used))


def _indices(texts: list[list[str]], count: int) -> NDArray[np.int32]:
    """Return 0-based indices from an OBJ's, which count from 1, or backwards from the end when negative."""
    index = np.array(texts, np.int64)
    return np.where(index < 0, index + count, index - 1).astype(np.int32)


def _read_finishes(catalogue: Catalogue, path: PurePosixPath) -> dict[str, Finish]:
    try:
        text = catalogue.read(str(path)).decode("latin1")
    except (KeyError, OSError):
        return {}
    found: dict[str, Finish] = {}
    for block in re.split(r"^\s*newmtl\s+", text, flags=re.M)[1:]:
        name, *lines = block.splitlines()
        values = {words[0]: words[1:] for line in lines if (words := line.split())}
        found[name.strip()] = _finish(catalogue, path.parent, values)
    return found


def _finish(catalogue: Catalogue, folder: PurePosixPath, values: dict[str, list[str]]) -> Finish:
    texture = _read_texture(catalogue, folder, values.get("map_Kd"))
    display = np.array([float(v) for v in values.get("Kd", ["0.6"] * 3)[:3]])
    color = np.ones(3) if texture is not None else np.clip(display, 0, 1) ** 2.2
    opacity = float(values.get("d", ["1"])[0])
    shine = float(np.mean([float(v) for v in values.get("Ks", ["0"])[:3]]))
    hardness = float(values.get("Ns", ["10"])[0])
    rough = 0.75 if shine < 0.05 else float(np.clip((2 / (2 + hardness)) ** 0.25, 0.12, 0.7))
    red, green, blue = np.clip(color, DARKEST, 0.92)
    return Finish(
        color=(float(red), float(green), float(blue)),
        texture=texture,
        roughness=rough,
        glass=float(np.clip(1 - opacity, 0, 0.95)) if texture is None else 0.0,
    )


def _read_texture(
    catalogue: Catalogue, folder: PurePosixPath, words: list[str] | None
) -> NDArray[np.uint8] | None:
    """Return the texture with at most TEXTURE_SIDE per side, or None where it is missing: the colour then
    replaces it.
    """
    if not words:
        return None
    try:
        with Image.open(io.BytesIO(catalogue.read(str(folder / words[-1])))) as image:
            wanted = "RGBA" if "A" in image.getbands() or "transparency" in image.info else "RGB"
            picture = image.convert(wanted)
    except (KeyError, OSError, ValueError):
        return None
    picture.thumbnail((TEXTURE_SIDE, TEXTURE_SIDE), Image.Resampling.BOX)
    texture = np.asarray(picture)
    opaque = texture.shape[2] == 4 and texture[..., 3].min() > 250
    return texture[..., :3] if opaque else texture


def _turned(mesh: Mesh, rotation: str | None) -> Mesh:
    """Return the mesh turned by the catalogue's nine numbers, which are for y up."""
    if not rotation:
        return mesh
    to_upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    turn = to_upright @ np.array(rotation.split(), float).reshape(3, 3) @ to_upright.T
    return Mesh(
        (mesh.vertices @ turn.T).astype(np.float32),
        mesh.faces,
        mesh.uv,
        mesh.slots,
        mesh.finishes,
        mesh.smooth,
    )


def _fitted(mesh: Mesh, size: tuple[float, float, float]) -> Mesh:
    """Return the mesh in that size, standing on the ground, centred on the z axis."""
    scale = np.asarray(size) / np.maximum(mesh.size, 1e-6)
    foot = mesh.low + mesh.size * [0.5, 0.5, 0]
    at = ((mesh.vertices - foot) * scale).astype(np.float32)
    return Mesh(at, mesh.faces, mesh.uv, mesh.slots, mesh.finishes, mesh.smooth)
