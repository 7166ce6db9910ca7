"""SynthBench: rendered pairs with very different lights and their true Lumi maps, made from a seed.

    {out}/synthbench.json          format, seed, pairs, resolution and samples
    {out}/{pair}/source.png        the photo, 8-bit sRGB
    {out}/{pair}/target.png        the truth
    {out}/{pair}/*_lumi.exr        their Lumi maps, linear
    {out}/{pair}/mask.png          white under the benchmark's strokes; their light is the target's map

Copying the source scores at most MOST_COPY dB on every pair. Scene numbers lie above all those that
`dior-rt train render` can reach, so training never sees their geometry. Every second pair contains a human
figure, which training never sees either. Half of the pairs are plain scenes, half are of the world domain.

A preview with few rays decides on the lights. Then only the sources that are lit in one of the two pictures
are rendered in full.
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
DRAWS: Final = 200  # draws of lights before the next scene is tried
FIRST: Final = 901_000_000  # the first scene number; `render` uses smaller ones
STRIDE: Final = 1000  # scene numbers per pair; each seed has room for 1000 pairs
FORMAT: Final = 2
PREVIEW: Final = 2  # rays per pixel and source, at half the resolution
MARGIN: Final = 0.5  # dB by which a preview must stay below MOST_COPY


@dataclass(frozen=True)
class Recipe:
    """The settings of a SynthBench.

    resolution: pixels a side. samples: rays per pixel and source, before denoising.
    speckle: the largest allowed noise of either picture, in 0..255; photos of 128 x 128 pixels have 5 to 8.
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
    """Render the missing pairs. shard: (index, count), this process's share.

    Raises InputError if nothing can be written, or if the folder holds pairs with other settings.
    """
    mitsuba()  # without it or the figures, no folder is made
    person(np.random.default_rng(0), 1.0, 0.0, np.zeros(3))
    make_folder(out)
    _agree(out / HEAD, recipe)
    index, shards = shard
    numbers = range(index, recipe.pairs, shards)
    for done, number in enumerate(numbers):
        folder = out / f"{number:04d}"
        if not (folder / LAST).exists():
            _save(folder, make(number, recipe))
        if progress:
            progress(done + 1, len(numbers))


def make(number: int, recipe: Recipe) -> Task:
    """Return the pair of that number.

    It is made from the first of its STRIDE scenes whose lights differ enough and leave little noise. Raises
    InputError if there is none.
    """
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
    raise InputError(f"Pair {number} has no scene without noise; take more samples than {recipe.samples}.")


def shown(seen: View, seed: list[int]) -> tuple[Pair, Shown, Shown]:
    """Return the pair of a view that a seed draws, and its pictures in 8-bit sRGB."""
    sample = pair(np.random.default_rng(seed), seen, "replace")
    return sample, OPS.encode_srgb(sample.photo, np.uint8), OPS.encode_srgb(sample.relit, np.uint8)


def differing(preview: View) -> list[int] | None:
    """Return the first seed whose lights differ enough in the preview, or None."""
    for draw in range(DRAWS):
        seed = [preview.seed, 5, draw]
        _, source, truth = shown(preview, seed)
        if psnr(source, truth) <= MOST_COPY - MARGIN:
            return seed
    return None


def used(preview: View, seed: list[int]) -> NDArray[np.bool_]:
    """Return which sources are lit in either picture of the seed's pair, (sources,) bool."""
    rng = np.random.default_rng(seed)
    usable = usable_sources(preview)
    lights = random_lights(rng, usable) + random_lights(rng, usable)
    return np.asarray(lights.any(axis=1))


def in_full(
    stage: Stage, described: Scene, camera: Camera, preview: View, chosen: NDArray[np.bool_], recipe: Recipe
) -> View:
    """Return the view with the chosen sources rendered in full and denoised; the others are dark."""
    lamps = replace(described, sources=tuple(described.sources[k] for k in np.flatnonzero(chosen)))
    full = view(stage, lamps, camera, preview.seed, recipe.resolution, recipe.samples, denoised=True)
    images = np.zeros((chosen.size, *full.images.shape[1:]), np.float16)
    lumi = images.copy()
    images[chosen], lumi[chosen] = full.images, full.lumi
    return replace(preview, images=images, lumi=lumi)


def staged(scene_number: int, number: int) -> Scene:
    """Return a scene with one camera for the pair of that number.

    Odd pairs have a human figure in front. Pairs whose half is odd are of the world domain.
    """
    described = DOMAINS["world" if number // 2 % 2 else "plain"].scene(scene_number, 1)
    if number % 2 == 0:
        return described
    rng: Generator = np.random.default_rng([scene_number, 6])
    at = np.array([rng.uniform(-0.6, 0.6), 0.0, rng.uniform(0.1, 0.9)])
    figure = person(rng, rng.uniform(1.3, 1.7), rng.uniform(-0.9, 0.9), at)
    return replace(described, things=(*described.things, *figure))


def _agree(path: Path, recipe: Recipe) -> None:
    """Write the settings, or check that the folder has the same."""
    if not path.exists():
        with replacing(path) as file:
            file.write(json.dumps(asdict(recipe), indent=2).encode())
    try:
        there = parse(Recipe, read_json(path, 1 << 16))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} does not describe a SynthBench.") from error
    if replace(there, pairs=recipe.pairs) != recipe:
        raise InputError(f"{path.parent} holds a SynthBench with other settings; choose another folder.")


def _save(folder: Path, task: Task) -> None:
    """Write a pair. The truth is written last, so a pair with a truth is complete."""
    assert task.source_lumi is not None and task.target_lumi is not None and task.mask is not None
    make_folder(folder)
    white = (task.mask * 255).astype(np.uint8)
    write_lumi(folder / "source_lumi.exr", task.source_lumi, {})
    write_lumi(folder / "target_lumi.exr", task.target_lumi, {})
    write_photo(folder / "mask.png", Photo(np.stack([white] * 3, axis=-1)), {})
    write_photo(folder / "source.png", Photo(task.source), {})
    write_photo(folder / LAST, Photo(task.truth), {})
