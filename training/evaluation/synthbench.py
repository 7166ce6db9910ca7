"""SynthBench: rendered pairs whose lights differ much, with their true Lumi maps, made from a seed.

    {out}/synthbench.json          format, seed, pairs, resolution and samples
    {out}/{pair}/source.png        the photo, 8-bit sRGB
    {out}/{pair}/target.png        the truth
    {out}/{pair}/*_lumi.exr        their Lumi maps, linear
    {out}/{pair}/mask.png          white where the benchmark's strokes speak; their light is the target's map

Copying the source scores at most MOST_COPY dB on every pair. Scene numbers lie above all those that
`dior-rt train render` can reach, so no geometry was ever trained on; in every second pair stands a human
figure, a kind of thing that training has none of. Half of the pairs are plain scenes, half are of the world.

Lights are decided on by a preview of few rays; only sources that are lit in one of the two pictures are then
rendered in full.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import make_folder, replacing
from dior_rt.images.photo import Photo, write_photo
from dior_rt.images.strokes import write_lumi
from dior_rt.records import parse, read_json
from dior_rt.training.data.render import DOMAINS, Stage, View, lit, mitsuba, view
from dior_rt.training.data.triplets import Pair, pair, random_lights, usable_sources
from dior_rt.training.evaluation.benchmarks import HEAD, LAST
from dior_rt.training.evaluation.metrics import Photo as Shown
from dior_rt.training.evaluation.metrics import psnr, speckle
from dior_rt.training.evaluation.people import person
from dior_rt.training.evaluation.tasks import OPS, Task
from dior_rt.training.scenes.scene import Camera, Scene

MOST_COPY: Final = 15.0  # dB
DRAWS: Final = 200  # of lights in a scene, before the next scene is tried
FIRST: Final = 901_000_000  # the first scene number; `render` has those below
STRIDE: Final = 1000  # scene numbers from pair to pair; of seeds, 1000 pairs
FORMAT: Final = 2
PREVIEW: Final = 2  # rays a pixel and source, of half as many pixels a side
MARGIN: Final = 0.5  # dB that a preview has to stay below MOST_COPY


@dataclass(frozen=True)
class Recipe:
    """What a SynthBench is made from. resolution: pixels a side. samples: rays a pixel and source, before
    denoising.

    speckle: the most that either picture may have, in 0..255; photos of 128 x 128 pixels have 5 to 8.
    """

    pairs: int = 600
    seed: int = 0
    resolution: int = 128
    samples: int = 8
    speckle: float = 8.0
    format: int = FORMAT


def render_synthbench(
    out: Path,
    recipe: Recipe,
    shard: tuple[int, int] = (0, 1),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the pairs that are not there yet. shard: (index, count), this process's share.

    Raises InputError where nothing can be written, or where the folder holds another recipe's pairs.
    """
    mitsuba()  # where it or the figures are missing, no folder is made
    person(np.random.default_rng(0), 1.0, 0.0, np.zeros(3))
    make_folder(out)
    _agree(out / HEAD, recipe)
    index, shards = shard
    mine = range(index, recipe.pairs, shards)
    for done, number in enumerate(mine):
        folder = out / f"{number:04d}"
        if not (folder / LAST).exists():
            _save(folder, make(number, recipe))
        if progress:
            progress(done + 1, len(mine))


def make(number: int, recipe: Recipe) -> Task:
    """The pair of that number: of the first of its STRIDE scenes with lights that differ enough and leave
    little noise. Raises InputError where there is none."""
    first = FIRST + recipe.seed * 1_000 * STRIDE + number * STRIDE
    for scene_number in range(first, first + STRIDE):
        described = staged(scene_number, number)
        camera = described.cameras[0]
        stage = Stage.load(described.things)
        described = lit(stage, described, camera)
        preview = view(stage, described, camera, scene_number, recipe.resolution // 2, PREVIEW)
        seed = differing(preview)
        if seed is None:
            continue
        seen = in_full(stage, described, camera, preview, used(preview, seed), recipe)
        sample, source, truth = shown(seen, seed)
        if psnr(source, truth) <= MOST_COPY and max(map(speckle, (source, truth))) <= recipe.speckle:
            mask = OPS.sparsify(sample.target, "strokes", number).mask
            return Task(f"{number:04d}", source, truth, sample.source, sample.target, mask, seed=number)
    raise InputError(f"Pair {number} finds no scene without noise; take more samples than {recipe.samples}.")


def shown(seen: View, seed: list[int]) -> tuple[Pair, Shown, Shown]:
    """The pair of a view that a seed draws, and its pictures as they are shown."""
    sample = pair(np.random.default_rng(seed), seen, "replace")
    return sample, OPS.encode_srgb(sample.photo, np.uint8), OPS.encode_srgb(sample.relit, np.uint8)


def differing(preview: View) -> list[int] | None:
    """The first seed whose lights differ enough by a preview, or None."""
    for draw in range(DRAWS):
        seed = [preview.seed, 5, draw]
        _, source, truth = shown(preview, seed)
        if psnr(source, truth) <= MOST_COPY - MARGIN:
            return seed
    return None


def used(preview: View, seed: list[int]) -> NDArray[np.bool_]:
    """(sources,) which are lit in either picture of the pair that the seed draws."""
    rng = np.random.default_rng(seed)
    usable = usable_sources(preview)
    lights = random_lights(rng, usable) + random_lights(rng, usable)
    return np.asarray(lights.any(axis=1))


def in_full(
    stage: Stage, described: Scene, camera: Camera, preview: View, chosen: NDArray[np.bool_], recipe: Recipe
) -> View:
    """The previewed view with the chosen sources rendered in full, and denoised; the others are dark."""
    lamps = replace(described, sources=tuple(described.sources[k] for k in np.flatnonzero(chosen)))
    full = view(stage, lamps, camera, preview.seed, recipe.resolution, recipe.samples, denoised=True)
    images = np.zeros((chosen.size, *full.images.shape[1:]), np.float16)
    lumi = images.copy()
    images[chosen], lumi[chosen] = full.images, full.lumi
    return replace(preview, images=images, lumi=lumi)


def staged(scene_number: int, number: int) -> Scene:
    """A scene for the pair of that number, by one camera: with a human figure in front if it is odd, of the
    world if its half is."""
    described = DOMAINS["world" if number // 2 % 2 else "plain"].scene(scene_number, 1)
    if number % 2 == 0:
        return described
    rng: Generator = np.random.default_rng([scene_number, 6])
    at = np.array([rng.uniform(-0.6, 0.6), 0.0, rng.uniform(0.1, 0.9)])
    figure = person(rng, rng.uniform(1.3, 1.7), rng.uniform(-0.9, 0.9), at)
    return replace(described, things=(*described.things, *figure))


def _agree(path: Path, recipe: Recipe) -> None:
    """Write the recipe, or see that it is the one that is there."""
    if not path.exists():
        with replacing(path) as file:
            file.write(json.dumps(asdict(recipe), indent=2).encode())
    try:
        there = parse(Recipe, read_json(path, 1 << 16))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} describes no SynthBench.") from error
    if replace(there, pairs=recipe.pairs) != recipe:
        raise InputError(f"{path.parent} holds a SynthBench of another recipe; name another folder.")


def _save(folder: Path, task: Task) -> None:
    """Write a pair; the truth last, so that a pair that has it is whole."""
    assert task.source_lumi is not None and task.target_lumi is not None and task.mask is not None
    make_folder(folder)
    white = (task.mask * 255).astype(np.uint8)
    write_lumi(folder / "source_lumi.exr", task.source_lumi, {})
    write_lumi(folder / "target_lumi.exr", task.target_lumi, {})
    write_photo(folder / "mask.png", Photo(np.stack([white] * 3, axis=-1)), {})
    write_photo(folder / "source.png", Photo(task.source), {})
    write_photo(folder / LAST, Photo(task.truth), {})
