"""Stage 2: a LoRA on renders and on real photos at once, for any backbone.

The Lumi map of a real pair, two photos of one view under different light, is unknown. The model draws it: its
estimate of the target, with the gradient stopped, is sparsified and becomes the strokes under which the
source must be relit. Training on rendered triplets continues at the same time, so that the model keeps what
it has learnt:

    loss = mean over the real pairs + rendered_weight * mean over the rendered triplets

Each of a batch's halves is one of the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, get_args

import numpy as np
import torch
from numpy.random import Generator
from PIL import Image, UnidentifiedImageError
from torch import Tensor
from torch.utils.data import IterableDataset

from dior_rt.errors import InputError
from dior_rt.families.mini import MODES
from dior_rt.files import reason
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.images.photo import read_photo
from dior_rt.kernels import NumpyOps
from dior_rt.kernels.ops import Mode as Sparsity
from dior_rt.training.backbone import Backbone
from dior_rt.training.fit import Batch, Plan, Progress, rendered, run
from dior_rt.training.light import RELIT_SCALE, linear_to_srgb

OPS: Final = NumpyOps()
SPARSITIES: Final = get_args(Sparsity)
REAL: Final = 1  # separates the random draws of real pairs from those of triplets


@dataclass(frozen=True)
class Mixture:
    """The mixture of the two kinds of data.

    rendered_weight: lambda above. estimate_steps: steps of the flow to the light of a target. One step leads
    to the mean of the possible maps, more steps lead to a sample of them.
    """

    rendered_weight: float = 1.0
    estimate_steps: int = 1


@dataclass(frozen=True)
class Scene:
    """Photos of one view, of one size, under different light."""

    photos: tuple[Path, ...]


def load_scenes(folder: Path, pattern: str = "*") -> list[Scene]:
    """Return the scenes <folder>/<scene>/<photo>, where the names of the photos match `pattern`.

    Only the photos' headers are read. Raises InputError where there is no scene, where one has fewer than two
    photos, and where its photos differ in size.
    """
    try:
        folders = sorted(path for path in folder.iterdir() if path.is_dir())
    except OSError as error:
        raise InputError(f"Cannot read the folder of pairs {folder}: {reason(error)}.") from error
    if not folders:
        raise InputError(f"There are no scenes in {folder}: each should be a folder of photos of one view.")
    return [_load_scene(path, pattern) for path in folders]


def _load_scene(folder: Path, pattern: str) -> Scene:
    photos = sorted(path for path in folder.glob(pattern) if path.is_file())
    if len(photos) < 2:
        raise InputError(f"The scene {folder} has {len(photos)} photos like {pattern!r}; a pair takes two.")
    sizes = {path: _size(path) for path in photos}
    other = next((path for path in photos if sizes[path] != sizes[photos[0]]), None)
    if other:
        raise InputError(
            f"The photos of one scene must be of one view; {photos[0]} and {other} differ in size."
        )
    return Scene(tuple(photos))


def _size(path: Path) -> tuple[int, int]:
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, ValueError, SyntaxError) as error:
        raise InputError(f"Cannot read the photo {path}: {reason(error)}.") from error


def real_pair(rng: Generator, scene: Scene, grid: tuple[int, int]) -> Batch:
    """Return two photos of a scene as a triplet without strokes: one window of both, at the grid's size."""
    chosen = rng.choice(len(scene.photos), 2, replace=False)
    photo, relit = (read_photo(scene.photos[k]).pixels for k in chosen)
    rows, columns = _window(rng, photo.shape[:2], grid)
    mirror = rng.uniform() < 0.5

    def seen(pixels: np.ndarray) -> Tensor:
        cells = OPS.reduce_photo(pixels[rows, columns], grid)
        planes = torch.from_numpy(cells[:, ::-1].copy() if mirror else cells).permute(2, 0, 1)
        return linear_to_srgb(planes).contiguous()

    source, target = seen(photo), seen(relit)
    return {
        "photo": source,
        "light": torch.zeros_like(source),
        "mask": torch.zeros_like(source[:1]),
        "mode": torch.tensor(MODES["relight"]),
        "x0": RELIT_SCALE * (target - source),
    }


def _window(rng: Generator, size: tuple[int, ...], grid: tuple[int, int]) -> tuple[slice, slice]:
    """Return a random part of a picture, of the grid's shape and at least 0.7 of the largest that fits."""
    scale = rng.uniform(0.7, 1.0) * min(size[0] / grid[0], size[1] / grid[1])
    height, width = (max(1, round(side * scale)) for side in grid)
    top, left = rng.integers(0, size[0] - height + 1), rng.integers(0, size[1] - width + 1)
    return slice(top, top + height), slice(left, left + width)


class MixedBatches(IterableDataset[Batch]):
    """Batches of which one half is real pairs and the other half rendered triplets.

    The n-th is always the same.

    `real` (B,) marks the real samples, `weight` (B,) is the weight of each error, and `seed` draws the
    strokes.
    """

    def __init__(
        self,
        scenes: list[Scene],
        triplets: IterableDataset[Batch],
        seed: tuple[int, ...],
        start: int,
        weight: float,
    ) -> None:
        """Store the options.

        triplets: a stream whose first batch has the number `start`. weight: of the rendered half.
        """
        super().__init__()
        self.scenes, self.triplets = scenes, triplets
        self.seed, self.start, self.weight = seed, start, weight

    def __iter__(self) -> Iterator[Batch]:
        for number, triplets in enumerate(self.triplets, start=self.start):
            yield self.mix(np.random.default_rng([*self.seed, number]), triplets)

    def mix(self, rng: Generator, triplets: Batch) -> Batch:
        """Put as many real pairs as there are triplets, of the same grid, before them."""
        count, grid = len(triplets["x0"]), (triplets["x0"].shape[2], triplets["x0"].shape[3])
        chosen = rng.integers(len(self.scenes), size=count)
        pairs = [real_pair(rng, self.scenes[k], grid) for k in chosen]
        real = {name: torch.stack([sample[name] for sample in pairs]) for name in pairs[0]}
        batch = {name: torch.cat([real[name], triplets[name]]) for name in real}
        is_real = torch.arange(2 * count) < count
        weight = torch.where(is_real, 2.0, 2.0 * self.weight)  # a mean over all is half the sum of two means
        return {**batch, "real": is_real, "weight": weight, "seed": torch.tensor(int(rng.integers(2**31)))}


def fit_stage2(
    make: Callable[[], Backbone],
    renders: Path,
    scenes: list[Scene],
    out: Path,
    plan: Plan,
    mixture: Mixture = Mixture(),
    progress: Progress | None = None,
) -> None:
    """Train the backbone of `make` on renders and real pairs. Resumes where the folder `out` holds a state.

    Raises InputError for an odd batch, and the errors of `fit`.
    """
    if plan.batch % 2:
        raise InputError(f"Half of a batch is real pairs, so it must be even; {plan.batch} is not.")
    triplets = rendered(renders, replace(plan, batch=plan.batch // 2))

    torch.manual_seed(plan.seed)
    backbone = make()

    def stream(start: int, rank: int) -> MixedBatches:
        seed = (plan.seed, rank, REAL)
        return MixedBatches(scenes, triplets(start, rank), seed, start, mixture.rendered_weight)

    def prepare(batch: Batch) -> Batch:
        return backbone.prepare(with_estimated_strokes(backbone, batch, mixture.estimate_steps, plan.shift))

    run(backbone.network, stream, out, plan, progress, backbone.save, prepare)


def with_estimated_strokes(backbone: Backbone, batch: Batch, steps: int, shift: float) -> Batch:
    """Return the batch with strokes for its real pairs, sparsified from the model's estimate of their
    targets.
    """
    real, seed = batch["real"], int(batch["seed"])
    target = batch["photo"][real] + batch["x0"][real] / RELIT_SCALE
    lumi = estimate(backbone, target.clamp(0, 1), seed, ShiftSchedule(shift).sigmas(steps).tolist())
    light, mask = batch["light"].clone(), batch["mask"].clone()
    light[real], mask[real] = sparsified(lumi, np.random.default_rng(seed))
    return {**batch, "light": light, "mask": mask}


@torch.no_grad()
def estimate(backbone: Backbone, photos: Tensor, seed: int, sigmas: list[float]) -> Tensor:
    """Return Lumi maps (B, 3, h, w), linear, of photos, sRGB 0..1, as the network now estimates them."""
    count, nothing = len(photos), torch.zeros_like(photos)
    mode = torch.full((count,), MODES["estimate"], device=photos.device)
    asked = {"photo": photos, "light": nothing, "mask": nothing[:, :1], "mode": mode, "x0": nothing}
    inputs = backbone.prepare(asked)
    x0 = inputs.pop("x0")
    x = torch.randn(x0.shape, generator=torch.Generator().manual_seed(seed)).to(x0.device)
    for sigma, following in pairwise(sigmas):
        x = x + (following - sigma) * backbone.network(x=x, sigma=x.new_full((count,), sigma), **inputs)
    return backbone.lumi(x, (photos.shape[2], photos.shape[3]))


def sparsified(lumi: Tensor, rng: Generator) -> tuple[Tensor, Tensor]:
    """Return light (B, 3, h, w) and mask (B, 1, h, w) that a user might have drawn of each map, in any
    mode.
    """
    maps = lumi.float().permute(0, 2, 3, 1).cpu().numpy()
    modes = [SPARSITIES[k] for k in rng.integers(len(SPARSITIES), size=len(maps))]
    seeds = rng.integers(2**31, size=len(maps)).tolist()
    drawn = [OPS.sparsify(*each) for each in zip(maps, modes, seeds, strict=True)]
    light = torch.from_numpy(np.stack([strokes.light for strokes in drawn])).permute(0, 3, 1, 2)
    mask = torch.from_numpy(np.stack([strokes.mask for strokes in drawn]))[:, None]
    return light.to(lumi.device), mask.to(lumi.device)
