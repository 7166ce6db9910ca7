"""RealBench: pairs of rendered views that training never sees, one lamp changed, added or replaced.

    {out}/realbench.json           format, seed, pairs
    {out}/{pair}-{kind}/source.png, target.png, source_lumi.exr, target_lumi.exr, strokes.npy

The views come from a folder of files in the layout of a view store: `images` (K, H, W, 3) by light, `lumi` of
the same shape, or (lamps, H, W) for white lamps and `world_lumi` (H, W, 3) for the last. A view whose head
names the split `train` is refused.

A photo's own light is realistic: one to three lamps and what shines from everywhere, near-neutral, warm or
cool. The lamp that changes may have any colour. Strokes are drawn where the light changes most, half of them
flat.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np
from numpy.random import Generator

from dior_rt.errors import InputError
from dior_rt.files import make_folder, reason, replacing
from dior_rt.images.photo import Photo, write_photo
from dior_rt.images.strokes import read_lumi, write_lumi, write_strokes
from dior_rt.kernels import Strokes
from dior_rt.records import parse, read_json
from dior_rt.training.data.triplets import flat
from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.metrics import Raster, psnr
from dior_rt.training.evaluation.tasks import OPS, Benchmark, Task
from dior_rt.training.scenes.textures import rainbow

HEAD: Final = "realbench.json"
LAST: Final = "target.png"  # written last: where it is, the pair is whole
FORMAT: Final = 1
KINDS: Final = ("change", "add", "replace")
MOST_COPY: Final = 24.0  # dB; a pair that copying serves better changes too little to judge
DRAWS: Final = 64  # of lights in a view, before it is left out
WHITE_AT: Final = (0.4, 0.95)  # the range of a photo's exposure: its 95th percentile, of display white
BURNT: Final = 1.2  # the most that the target's 95th percentile may be, of display white
STROKES: Final = 2  # calls of the stroke generator, each of one to eight strokes


@dataclass(frozen=True)
class Recipe:
    """What a RealBench is made from."""

    pairs: int = 300
    seed: int = 0
    format: int = FORMAT


@dataclass(frozen=True)
class Lit:
    """A view by light. images, lumi: (K, H, W, 3) linear. world: whether the last shines from everywhere."""

    images: Raster
    lumi: Raster
    world: bool


def make_realbench(
    views: Path, out: Path, recipe: Recipe, progress: Callable[[int, int], None] | None = None
) -> None:
    """Make the pairs that are not there yet, view by view, the kinds in turn.

    Raises InputError where views are too few or unusable, or where the folder has pairs of another recipe.
    """
    paths = sorted(path for path in views.glob("**/*.npz") if not path.name.endswith(".g.npz"))
    if not paths:
        raise InputError(f"There are no views in {views}. Give a folder of rendered views (*.npz).")
    make_folder(out)
    _agree(out / HEAD, recipe)
    made, turn = 0, 0
    while made < recipe.pairs:
        if turn >= len(paths) * len(KINDS):
            raise InputError(f"{len(paths)} views give {made} pairs, not {recipe.pairs}. Render more views.")
        # Each view once for each kind; a new view every time, so that few views serve all kinds alike.
        path, kind = paths[turn % len(paths)], KINDS[(turn + turn // len(paths)) % len(KINDS)]
        turn += 1
        folder = out / f"{turn:04d}-{kind}"
        if not (folder / LAST).exists():
            task = make_pair(read_view(path), kind, [recipe.seed, turn], folder.name)
            if task is None:
                continue
            _save(folder, task)
        made += 1
        if progress:
            progress(made, recipe.pairs)


def read_view(path: Path) -> Lit:
    """Read a view's lights. Raises InputError for a file that is none, or that training may have seen."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            head = json.loads(str(stored["head"])) if "head" in stored else {}
            images, lumi = stored["images"].astype(np.float32), stored["lumi"].astype(np.float32)
            world = stored["world_lumi"].astype(np.float32) if "world_lumi" in stored else None
    except (OSError, BadZipFile, EOFError, KeyError, ValueError) as error:
        raise InputError(f"{path} is no view that can be used: {reason(error)}.") from error
    if head.get("split") == "train":
        raise InputError(f"{path} belongs to the training split. Give views of the test split.")
    if lumi.ndim == 3:
        lumi = np.repeat(lumi[..., None], 3, axis=-1)
    if world is not None:
        lumi = np.concatenate([lumi, world[None]])
    if images.shape != lumi.shape:
        raise InputError(f"{path} has {len(images)} pictures and {len(lumi)} Lumi maps.")
    kinds = head.get("kinds", [""])
    return Lit(images, lumi, world is not None or kinds[-1] in ("sky", "world"))


def make_pair(view: Lit, kind: str, seed: list[int], name: str) -> Task | None:
    """Draw lights until copying the source scores at most MOST_COPY; None where none do."""
    rng = np.random.default_rng(seed)
    for _ in range(DRAWS):
        lights = source_lights(rng, view)
        if lights is None:
            return None
        relights = change_lamp(rng, view, lights, kind)
        if relights is None:
            return None
        task = _shown(rng, view, lights, relights, name)
        if psnr(task.source, task.truth) <= MOST_COPY:
            return task
    return None


def source_lights(rng: Generator, view: Lit) -> Raster | None:
    """Return a photo's own light, (K, 3) strength times tint; None for a view of fewer than two lamps.

    One lamp at least stays off, so that one can be added.
    """
    lamps = len(view.images) - view.world
    if lamps < 2:
        return None
    lights = np.zeros((len(view.images), 3), np.float32)
    on = rng.permutation(lamps)[: rng.integers(1, min(3, lamps - 1) + 1)]
    lights[on] = [2 ** rng.uniform(-1.5, 1) * near_neutral(rng) for _ in on]
    if view.world:
        lights[-1] = 2 ** rng.uniform(-2.5, 0.5) * near_neutral(rng)
    return lights


def change_lamp(rng: Generator, view: Lit, lights: Raster, kind: str) -> Raster:
    """Return the lights with one lamp changed, added, or replaced by one that was off."""
    lamps = len(lights) - view.world
    lit = np.asarray(lights[:lamps].any(axis=1))
    on, off = np.flatnonzero(lit), np.flatnonzero(~lit)
    changed = lights.copy()
    if kind == "change":
        lamp = rng.choice(on)
        factor = 2 ** (rng.uniform(1, 2.5) * rng.choice([-1, 1]))
        changed[lamp] = factor * float(lights[lamp].mean()) * (any_color(rng) if rng.uniform() < 0.5 else 1)
    else:
        changed[rng.choice(off)] = 2 ** rng.uniform(-0.5, 2) * any_color(rng)
        if kind == "replace":
            changed[rng.choice(on)] = 0
    return changed


def near_neutral(rng: Generator) -> Raster:
    """Return a light's tint on the line from warm to cool; one in ten is saturated."""
    if rng.uniform() < 0.1:
        return any_color(rng)
    warmth = rng.normal(0, 0.15)
    return np.exp([warmth, 0.0, -1.4 * warmth]).astype(np.float32)


def any_color(rng: Generator) -> Raster:
    """Return the tint of a drawn light: white a third of the time, else any hue, of mean about 1."""
    if rng.uniform() < 1 / 3:
        return np.ones(3, np.float32)
    shade = 1 - rng.uniform(0.2, 1.0) * (1 - rainbow(rng.uniform()))
    return np.asarray(shade / max(float(shade.mean()), 0.4), np.float32)


def _shown(rng: Generator, view: Lit, lights: Raster, relights: Raster, name: str) -> Task:
    """Expose the pair as a camera would, and draw its strokes."""
    photo, source, relit, target = (
        np.einsum("khwc,kc->hwc", by_light, amounts)
        for amounts in (lights, relights)
        for by_light in (view.images, view.lumi)
    )
    bright, relit_bright = (
        max(float(np.percentile(light.max(axis=2), 95)), 1e-4) for light in (photo, relit)
    )
    exposure = np.float32(min(rng.uniform(*WHITE_AT) / bright, BURNT / relit_bright))
    before, after = (OPS.encode_srgb(np.clip(light * exposure, 0, 1), np.uint8) for light in (photo, relit))
    source, target = ((lumi * exposure).astype(np.float32) for lumi in (source, target))
    return Task(name, before, after, source, target, strokes=draw(rng, source, target))


def draw(rng: Generator, source: Raster, target: Raster) -> Strokes:
    """Draw the target's light where it differs most from the source's, half of the time in flat strokes."""
    change = np.abs(np.log((target + E) / (source + E))).max(axis=2)
    interest = (change**2 + 1e-6).astype(np.float32)
    masks = [OPS.sparsify(target, "strokes", int(rng.integers(2**31)), interest).mask for _ in range(STROKES)]
    mask = np.maximum.reduce(masks)
    light = flat(target, mask) if rng.uniform() < 0.5 else np.where(mask[..., None] > 0, target, 0)
    return Strokes(light.astype(np.float32), mask)


def realbench(folder: Path) -> list[Benchmark]:
    """Return what `make_realbench` made, in a folder. Raises InputError where there are no pairs."""
    if not (folder / HEAD).is_file():
        return []
    pairs = sorted(path.parent for path in folder.glob(f"*/{LAST}"))
    if not pairs:
        raise InputError(f"The RealBench in {folder} has no pairs. Make them with `dior-rt train realbench`.")
    return [Benchmark("RealBench", tuple(partial(_load, path, k) for k, path in enumerate(pairs)), True)]


def _load(folder: Path, number: int) -> Task:
    source, truth = read_picture(folder / "source.png"), read_picture(folder / LAST)
    before, after = (read_lumi(folder / f"{name}_lumi.exr") for name in ("source", "target"))
    try:
        drawn = np.load(folder / "strokes.npy", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"Cannot read the strokes in {folder}: {reason(error)}.") from error
    strokes = Strokes(np.ascontiguousarray(drawn[..., :3]), np.ascontiguousarray(drawn[..., 3]))
    return Task(folder.name, source, truth, before, after, seed=number, strokes=strokes)


def _save(folder: Path, task: Task) -> None:
    """Write a pair; the truth last, so that a pair that has it is whole."""
    assert task.source_lumi is not None and task.target_lumi is not None and task.strokes is not None
    make_folder(folder)
    write_lumi(folder / "source_lumi.exr", task.source_lumi, {})
    write_lumi(folder / "target_lumi.exr", task.target_lumi, {})
    write_strokes(folder / "strokes.npy", task.strokes, {})
    write_photo(folder / "source.png", Photo(task.source), {})
    write_photo(folder / LAST, Photo(task.truth), {})


def _agree(path: Path, recipe: Recipe) -> None:
    """Write the recipe, or check that the one that is there differs in nothing but the number of pairs."""
    if not path.exists():
        with replacing(path) as file:
            file.write(json.dumps(asdict(recipe), indent=2).encode())
    try:
        there = parse(Recipe, read_json(path, 1 << 16))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} describes no RealBench: {reason(error)}.") from error
    if replace(there, pairs=recipe.pairs) != recipe:
        raise InputError(f"{path.parent} holds a RealBench of another recipe. Name another folder.")
