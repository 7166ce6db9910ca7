"""Triplets (photo, strokes, relit photo) mixed on the fly from renders of single sources, in linear light.

A photo is the sum of its sources' renders, each with a strength and a tint, under one exposure that source
and target share. Its Lumi map is the same sum of their Lumi maps. There are four kinds of pair: one light is
added, removed or changed, and the strokes mark the important places; the same in only one part of the
picture; all lights are replaced; nothing changes. A camera makes pictures of the light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import label
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import IterableDataset

from dior_rt.errors import InputError
from dior_rt.families import Mode
from dior_rt.families.mini import MODES
from dior_rt.kernels import NumpyOps
from dior_rt.kernels.ops import Mode as Sparsity
from dior_rt.light import log_ratio
from dior_rt.training.data.camera import Camera, random_camera, white_balance
from dior_rt.training.data.render import View
from dior_rt.training.light import RELIT_SCALE, encode_lumi
from dior_rt.training.scenes.textures import rainbow

Lights = NDArray[np.float32]  # (sources, 3): strength times tint
Raster = NDArray[np.float32]
Grids = tuple[tuple[int, int], ...]  # (rows, columns) in cells

GRIDS: Grids = ((64, 64), (56, 80), (80, 56))
CHANGES = ("change", "local", "dab")  # of one light, of one place, and of the place of a lone dab
KINDS = (*CHANGES, "replace", "keep")
KIND_SHARES = (0.26, 0.20, 0.20, 0.25, 0.09)
# All lights of a part of the picture change by any factor. The part has these radii, as a share of the
# shorter side. A lone dab describes the light of the part about it.
PARTS = {"local": (0.15, 0.6), "dab": (0.1, 0.35)}
FALL = (2.5, 8.0)  # the power of the distance at which they end
STOPS = 4.0  # the largest of these changes, in stops
BURNT = 0.25  # the share of pairs whose relit picture may be far too bright for the display
DAB = (0.04, 0.15)  # the radius of a lone dab, as a share of the shorter side
DIMMEST = 0.02  # mean of a usable source's Lumi map; fainter ones miss what the camera sees


@dataclass(frozen=True)
class Pair:
    """Photo and relit photo, linear, clipped at display white, and their Lumi maps; all (H, W, 3) float32."""

    kind: str
    photo: Raster
    relit: Raster
    source: Raster
    target: Raster


def mix(view: View, lights: Lights) -> tuple[Raster, Raster]:
    """Return the image and the Lumi map of a view under some lights."""
    image = np.zeros(view.images.shape[1:], np.float32)
    lumi = np.zeros_like(image)
    for k in np.flatnonzero(lights.any(axis=1)):
        image += view.images[k] * lights[k]
        lumi += view.lumi[k] * lights[k]
    return image, lumi


def tint(rng: Generator) -> Raster:
    """Return a light's colour, of luminance about 1: white, warm or cool half of the time, else any hue."""
    if rng.uniform() < 0.5:
        warmth = rng.normal(0, 0.25)
        return np.exp([warmth, 0.0, -1.4 * warmth]).astype(np.float32)
    hue, saturation = rng.uniform(), rng.uniform(0.2, 1.0)
    shade = 1 - saturation * (1 - rainbow(hue))
    return (shade / max(shade.mean(), 0.4)).astype(np.float32)


def usable_sources(view: View) -> NDArray[np.bool_]:
    """Return (sources,), which of them light enough of what the camera sees."""
    return np.asarray(view.lumi.mean(axis=(1, 2, 3), dtype=np.float32) > DIMMEST)


def random_lights(rng: Generator, usable: NDArray[np.bool_]) -> Lights:
    """Return one or more of the usable sources, at strengths over about three stops, tinted."""
    on = usable & (rng.uniform(size=usable.size) < 0.55)
    if not on.any():
        on = np.zeros_like(usable)
        on[rng.choice(np.flatnonzero(usable))] = True
    strengths = 2 ** rng.uniform(-2, 1, usable.size) * on
    return strengths.astype(np.float32)[:, None] * np.stack([tint(rng) for _ in usable])


def change_one(rng: Generator, lights: Lights, usable: NDArray[np.bool_]) -> Lights:
    """Return the lights with one added, removed, dimmed, strengthened or tinted anew.

    The last one is never removed.
    """
    changed = lights.copy()
    k = rng.choice(np.flatnonzero(usable))
    if not lights[k].any():
        changed[k] = 2 ** rng.uniform(-1.5, 2) * tint(rng)
        return changed
    alone = np.count_nonzero(lights.any(axis=1)) == 1
    how = rng.choice(["strength", "tint"] if alone else ["remove", "strength", "tint"])
    if how == "remove":
        changed[k] = 0
    elif how == "strength":
        changed[k] *= 2 ** rng.uniform(-3, 3)
    else:
        changed[k] = np.linalg.norm(lights[k]) / np.sqrt(3) * tint(rng)
    return changed


def gel(rng: Generator) -> Raster:
    """Return (3,), the factor and tint of all lights of a place.

    If the factor were mostly next to 1, the strokes would reveal the light that is there, and half the drawn
    light would not be taken at its value.
    """
    return np.float32(2 ** rng.uniform(-STOPS, STOPS)) * tint(rng)


def exposed(image: Raster, white: float) -> float:
    """Return the exposure that brings an image's 95th percentile to `white`."""
    return white / max(float(np.percentile(image.max(axis=2), 95)), 1e-4)


def flag(rng: Generator, shape: tuple[int, int], radii: tuple[float, float]) -> Raster:
    """Return (h, w) in 0..1, the share of a light that passes where flags block it except in one soft-edged
    part.

    radii: the smallest and the largest radius of the part, as a share of the shorter side.
    """
    rows, columns = np.indices(shape) + 0.5
    x = (columns - rng.uniform(0, shape[1])) / min(shape)
    y = (rows - rng.uniform(0, shape[0])) / min(shape)
    angle = rng.uniform(0, np.pi)
    wide, long = np.exp(rng.uniform(np.log(radii[0]), np.log(radii[1]), 2))
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    away = np.hypot(along / long, across / wide)  # 1 where half of the light passes
    return (1 / (1 + away ** rng.uniform(*FALL))).astype(np.float32)


def pair(
    rng: Generator,
    view: View,
    kind: str | None = None,
    burnt: bool = False,
    balance: Raster | float = 1.0,
) -> Pair:
    """Return a random pair of one view, of that kind or of any.

    burnt: the relit picture may be far too bright for the display. balance: (3,) tints all lights alike.
    """
    usable = usable_sources(view)
    kind = kind or str(rng.choice(KINDS, p=KIND_SHARES))
    lights = random_lights(rng, usable)
    relights = lights
    if kind in CHANGES:
        relights = lights * gel(rng) if kind in PARTS else change_one(rng, lights, usable)
    elif kind == "replace":
        relights = random_lights(rng, usable)
    photo, source = mix(view, lights * balance)
    relit, target = mix(view, relights * balance)
    if kind in PARTS:
        passing = flag(rng, photo.shape[:2], PARTS[kind])[..., None]
        relit, target = photo + passing * (relit - photo), source + passing * (target - source)
    exposure, strength = exposed(photo, rng.uniform(0.3, 1.1)), 1.0
    # A picture that is mostly white teaches little. One changed light must keep its strength relative to the
    # others, so the exposure is reduced for it. Lights that replace all others may have any suitable
    # strength. But a user may draw light that burns a place out, and must then see it burn.
    if kind in ("change", "local") and not burnt:
        exposure = min(exposure, exposed(relit, rng.uniform(0.9, 1.5)))
    elif kind == "replace":
        strength = exposed(relit, 2 ** rng.uniform(0, 2) if burnt else rng.uniform(0.3, 1.1)) / exposure
    return Pair(
        kind,
        photo=np.clip(photo * exposure, 0, 1),
        relit=np.clip(relit * strength * exposure, 0, 1),
        source=source * exposure,
        target=target * strength * exposure,
    )


def window(rng: Generator, size: int, grid: tuple[int, int]) -> tuple[slice, slice, bool]:
    """Return a random part of a square picture in the grid's shape, and whether to mirror it."""
    scale = rng.uniform(0.7, 1.0) * size / max(grid)
    height, width = round(grid[0] * scale), round(grid[1] * scale)
    top, left = rng.integers(0, size - height + 1), rng.integers(0, size - width + 1)
    return slice(top, top + height), slice(left, left + width), bool(rng.uniform() < 0.5)


def part(view: View, rows: slice, columns: slice) -> View:
    return replace(view, images=view.images[:, rows, columns], lumi=view.lumi[:, rows, columns])


def zoomed(sample: Pair, grid: tuple[int, int], mirror: bool = False) -> Pair:
    """Return the pair resampled to the grid, in linear light."""
    rasters = np.stack([sample.photo, sample.relit, sample.source, sample.target])
    planes = torch.from_numpy(rasters).permute(0, 3, 1, 2)
    small = F.interpolate(planes, size=grid, mode="bilinear", antialias=True).clamp_min(0)
    if mirror:
        small = small.flip(3)
    return Pair(sample.kind, *small.permute(0, 2, 3, 1).contiguous().numpy())


def interest(sample: Pair) -> Raster:
    """Return (h, w), where a user would draw: where the light changes most."""
    change = np.abs(log_ratio(sample.target, sample.source)).max(axis=2)
    return (change**2 + 1e-6).astype(np.float32)


def draw(rng: Generator, ops: NumpyOps, sample: Pair) -> tuple[Raster, Raster]:
    """Return light (h, w, 3) and mask (h, w) that a user might have drawn for the pair, at grid size."""
    if sample.kind == "dab":
        mask = dab(rng, interest(sample))
        return flat(sample.target, mask), mask
    at_change = sample.kind in CHANGES and rng.uniform() < 0.85
    modes: tuple[Sparsity, ...] = ("strokes", "coarse", "dense")
    mode = "strokes" if at_change else modes[rng.choice(3, p=[0.5, 0.25, 0.25])]
    where = interest(sample) if at_change else None
    # Users draw at least two strokes when one or all lights change. A lone stroke marks its own place.
    times = 2 if mode == "strokes" and sample.kind in ("change", "replace") else 1
    drawn = [ops.sparsify(sample.target, mode, int(rng.integers(2**31)), where) for _ in range(times)]
    light = np.max([strokes.light for strokes in drawn], axis=0)
    mask = np.max([strokes.mask for strokes in drawn], axis=0)
    return (flat(sample.target, mask) if at_change and rng.uniform() < 0.5 else light), mask


def dab(rng: Generator, interest: Raster) -> Raster:
    """Return the mask (h, w) of one round touch of the brush, placed by interest."""
    height, width = interest.shape
    share = interest.ravel().astype(np.float64)
    centre = int(rng.choice(share.size, p=share / share.sum()))
    radius = max(rng.uniform(*DAB) * min(height, width), 1.0)
    rows, columns = np.indices((height, width))
    away = np.hypot(rows - centre // width, columns - centre % width)
    return (away <= radius).astype(np.float32)


def flat(lumi: Raster, mask: Raster) -> Raster:
    """Return the map under a mask with the mean colour of each stroke, because a brush has one colour and a
    map varies.
    """
    strokes, count = label(mask > 0)
    light = np.zeros_like(lumi)
    for k in range(1, count + 1):
        light[strokes == k] = lumi[strokes == k].mean(axis=0)
    return light


@dataclass(frozen=True)
class Mix:
    """The shares of the sample kinds.

    The share of samples that estimate, besides estimating the photo's own light as all do; and of the others,
    the share without strokes, for guidance.
    """

    estimate: float = 0.04
    null: float = 0.06


class Batches(IterableDataset[dict[str, Tensor]]):
    """An endless stream of batches: the network's inputs, `x0` and `own`. The n-th is the same on every run.

    start: the number of the first batch. rank: the number of this process, where several train together.
    grids: a batch's light grid is one of these.
    """

    def __init__(
        self,
        views: list[View],
        batch: int,
        seed: int,
        start: int = 0,
        shares: Mix = Mix(),
        rank: int = 0,
        grids: Grids = GRIDS,
    ) -> None:
        super().__init__()
        self.views, self.batch, self.shares, self.grids = views, batch, shares, grids
        self.seed, self.rank, self.start = seed, rank, start

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        number = self.start
        while True:
            yield self.make(np.random.default_rng([self.seed, self.rank, number]))
            number += 1

    def make(self, rng: Generator) -> dict[str, Tensor]:
        grid = self.grids[rng.integers(len(self.grids))]
        # Each sample has its own random generator, so a view that draws more or fewer numbers does not
        # change the others.
        samples = [self._sample(stream, grid) for stream in rng.spawn(self.batch)]
        return {name: torch.stack([sample[name] for sample in samples]) for name in samples[0]}

    def _sample(self, rng: Generator, grid: tuple[int, int]) -> dict[str, Tensor]:
        view = self.views[rng.integers(len(self.views))]
        rows, columns, mirror = window(rng, view.images.shape[1], grid)
        burnt, balance = rng.uniform() < BURNT, white_balance(rng)
        small = zoomed(pair(rng, part(view, rows, columns), burnt=burnt, balance=balance), grid, mirror)
        shots = Shots.of(small, random_camera(rng), rng)
        if rng.uniform() < self.shares.estimate:
            return example(small, shots, None, "estimate")
        strokes = None if rng.uniform() < self.shares.null else draw(rng, NumpyOps(), small)
        return example(small, shots, strokes, "relight")


@dataclass(frozen=True)
class Shots:
    """A camera's pictures of a pair: the photo in 8 bits, and the change that the new light makes.

    photo: (H, W, 3) float32, sRGB-encoded. change: that of the encoded values. The camera's flaws belong to
    the photo and stay in the relit picture, so the change contains none.
    """

    photo: Raster
    change: Raster

    @staticmethod
    def of(sample: Pair, camera: Camera, rng: Generator) -> Shots:
        change = camera.develop(sample.relit) - camera.develop(sample.photo)
        return Shots(camera.shot(sample.photo, rng), change)


def example(
    sample: Pair, shots: Shots, strokes: tuple[Raster, Raster] | None, mode: Mode
) -> dict[str, Tensor]:
    """Return the network's inputs for a pair, and the targets: x0, and `own`, the light on the photo."""

    def planes(raster: Raster) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(raster)).permute(2, 0, 1).contiguous()

    light, mask = strokes or (np.zeros_like(sample.photo), np.zeros(sample.photo.shape[:2], np.float32))
    source = 2 * encode_lumi(planes(sample.source)) - 1
    return {
        "photo": planes(shots.photo),
        "light": planes(light),
        "mask": planes(mask[..., None]),
        "mode": torch.tensor(MODES[mode]),
        "x0": RELIT_SCALE * planes(shots.change) if mode == "relight" else source,
        "own": source,
    }


def load_views(folder: Path) -> list[View]:
    """Return all views of a folder of renders, half a megabyte each. Raises InputError if there is none."""
    paths = sorted(folder.glob("*-*.npz"))
    if not paths:
        raise InputError(
            f"There are no renders in {folder}; make some with `dior-rt train render --out {folder}`."
        )
    return [View.load(path) for path in paths]
