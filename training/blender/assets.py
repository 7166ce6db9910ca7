"""The asset folder: the models, surfaces, panoramas and people that scenes are made of.

    models/<catalogue>-<n>.npz   furniture, animals, plants, vehicles, as `save_model` writes them
    people/<n>.npz               dressed people, of the same format
    models.json                  one Entry a model or person
    surfaces/  panoramas/        tiles and environments, as they come
    ATTRIBUTION.md               names, authors and licences of all models

Every asset belongs to "train" or to "bench" by its name alone, so the benchmark's assets stay unseen however
the folder grows.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.files import reason, replacing
from dior_rt.training.blender.meshes import Finish, Mesh

Split = Literal["train", "bench"]
TILE: Final = 128
KEPT_MODELS: Final = 150  # in memory
BENCH_SHARES: Final = {"model": 0.12, "surface": 0.12, "person": 0.15}
BENCH_PANORAMAS: Final = ("night", "lobby", "park", "studio")


def split_of(kind: str, name: str) -> Split:
    """Return the split of an asset, by its name alone: "train", or "bench" for assets held out for the
    benchmark.
    """
    if kind == "panorama":
        return "bench" if name in BENCH_PANORAMAS else "train"
    share = int.from_bytes(hashlib.sha256(f"{kind}:{name}".encode()).digest()[:4], "big") / 2**32
    return "bench" if share < BENCH_SHARES[kind] else "train"


@dataclass(frozen=True)
class Entry:
    """One model as the catalogue describes it.

    size: width, depth, height in metres. elevation: the height of its foot above the floor. top: the height
    at which objects can stand on it, or 0. place: "floor", "small", "wall", "outdoor", "vehicle", "animal" or
    "person".
    """

    file: str
    name: str
    size: tuple[float, float, float]
    elevation: float
    top: float
    place: str
    author: str
    licence: str


@dataclass(frozen=True)
class Assets:
    """The opened asset folder. Meshes and tiles are read when a scene first asks for them."""

    folder: Path
    entries: tuple[Entry, ...]
    kinds: tuple[str, ...] = field(repr=False)

    @staticmethod
    def open(folder: Path) -> Assets:
        """Open the folder. Raises InputError for a folder that `make_assets` did not write."""
        try:
            entries = json.loads((folder / "models.json").read_text())
            kinds = json.loads((folder / "surfaces" / "kinds.json").read_text())
            listed = tuple(Entry(**{**entry, "size": tuple(entry["size"])}) for entry in entries)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{folder} is no asset folder: {reason(error)}.") from error
        return Assets(folder, listed, tuple(kinds))

    @cached_property
    def _tiles(self) -> NDArray[np.uint8]:
        sheets = [
            np.asarray(Image.open(path).convert("RGB"))
            for path in sorted(self.folder.glob("surfaces/sheet*.webp"))
        ]
        cells = [
            sheet.reshape(-1, TILE, sheet.shape[1] // TILE, TILE, 3).swapaxes(1, 2).reshape(-1, TILE, TILE, 3)
            for sheet in sheets
        ]
        return np.concatenate(cells)[: len(self.kinds)]

    def tile(self, index: int) -> NDArray[np.uint8]:
        """Return a surface's colours: (128, 128, 3), sRGB."""
        return self._tiles[index]

    def surfaces(self, split: Split, *kinds: str) -> list[int]:
        """Return the indices of the split's surfaces, of the named kinds or of all."""
        return [
            k
            for k, kind in enumerate(self.kinds)
            if split_of("surface", str(k)) == split and (not kinds or kind in kinds)
        ]

    def models(self, split: Split, *places: str) -> list[Entry]:
        """Return the split's models that belong in one of the places."""
        return [
            entry
            for entry in self.entries
            if entry.place in places
            and split_of("person" if entry.place == "person" else "model", entry.file) == split
        ]

    def panoramas(self, split: Split) -> list[str]:
        """Return the names of the split's panoramas."""
        found = sorted(path.stem for path in self.folder.glob("panoramas/*.exr"))
        return [name for name in found if split_of("panorama", name) == split]

    def panorama_file(self, name: str) -> Path:
        return self.folder / "panoramas" / f"{name}.exr"

    def mesh(self, file: str) -> Mesh:
        """Return a model's mesh. The last ones are cached."""
        return load_model(self.folder / file)


def save_model(path: Path, mesh: Mesh) -> None:
    """Write a mesh with its finishes and textures into one file, whole or not at all."""
    finishes, arrays = [], {}
    for k, finish in enumerate(mesh.finishes):
        described = asdict(finish)
        if (texture := described.pop("texture")) is not None:
            arrays[f"texture{k}"] = texture
        finishes.append(described)
    if mesh.uv is not None:
        arrays["uv"] = mesh.uv.astype(np.float32)
    with replacing(path) as file:
        np.savez_compressed(
            file,
            vertices=mesh.vertices.astype(np.float32),
            faces=mesh.faces.astype(np.int32),
            slots=mesh.slots.astype(np.int32),
            smooth=np.float32(mesh.smooth),
            finishes=np.array(json.dumps(finishes)),
            **arrays,
        )


@lru_cache(KEPT_MODELS)
def load_model(path: Path) -> Mesh:
    """Read what `save_model` wrote. Raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            described = json.loads(str(stored["finishes"]))
            finishes = tuple(
                Finish(
                    **{**one, "color": tuple(one["color"])},
                    texture=stored.get(f"texture{k}"),
                )
                for k, one in enumerate(described)
            )
            uv = stored.get("uv")
            smooth = float(stored["smooth"])
            return Mesh(stored["vertices"], stored["faces"], uv, stored["slots"], finishes, smooth)
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        raise InputError(f"{path} is no model of an asset folder: {reason(error)}.") from error
