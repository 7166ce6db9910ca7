"""What a benchmark is made of: pairs of pictures, and what is known of their light."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from dior_rt.kernels import NumpyOps, Strokes
from dior_rt.training.evaluation.metrics import Photo, Raster

OPS: Final = NumpyOps()
Drawn = Literal["dense", "strokes"]
DRAWN: Final[tuple[Drawn, ...]] = ("dense", "strokes")


@dataclass(frozen=True)
class Task:
    """One pair of a benchmark, and what is known of its light.

    source, truth: (H, W, 3) 8-bit sRGB. source_lumi, target_lumi: (h, w, 3) linear Lumi maps, of the
    pictures' size if true, of the light grid if estimated, or None. mask: (h, w), where the benchmark's own
    strokes speak. Without it they are cut out of the target's map: seed and `interest` (h, w) say where.
    strokes: the benchmark's own, in place of a mask.
    """

    name: str
    source: Photo
    truth: Photo
    source_lumi: Raster | None = None
    target_lumi: Raster | None = None
    mask: Raster | None = None
    interest: Raster | None = None
    seed: int = 0
    strokes: Strokes | None = None

    def control(self, drawn: Drawn) -> Strokes:
        """The target's map, whole, or strokes cut out of it."""
        assert self.target_lumi is not None
        if drawn == "dense":
            return Strokes(self.target_lumi, np.ones(self.target_lumi.shape[:2], np.float32))
        if self.strokes is not None:
            return self.strokes
        if self.mask is not None:
            return Strokes(np.where(self.mask[..., None] > 0, self.target_lumi, 0), self.mask)
        return OPS.sparsify(self.target_lumi, "strokes", self.seed, interest=self.interest)


@dataclass(frozen=True)
class Benchmark:
    """name: of its table. load: its tasks, each read when it is wanted. true_maps: whether they come with
    true Lumi maps; without, the control is estimated from the target."""

    name: str
    load: tuple[Callable[[], Task], ...]
    true_maps: bool

    def __iter__(self) -> Iterator[Task]:
        return (load() for load in self.load)

    def __len__(self) -> int:
        return len(self.load)

    def first(self, count: int | None) -> Benchmark:
        """Its first tasks."""
        return replace(self, load=self.load[:count])
