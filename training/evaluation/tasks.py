"""The parts of a benchmark: pairs of pictures, and their known light."""

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
    """One pair of a benchmark, with its known light.

    source, truth: (H, W, 3) 8-bit sRGB. source_lumi, target_lumi: (h, w, 3) linear Lumi maps, of the
    pictures' size if true, of the light grid if estimated, or None. mask: (h, w), the places of the
    benchmark's strokes. Without it, strokes are cut from the target's map at places decided by seed and
    `interest` (h, w).
    strokes: the benchmark's strokes, in place of a mask.
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
        """Return the target's full map, or strokes cut from it."""
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
    """A set of tasks.

    name: the title of its table. load: functions that read each task. true_maps: whether the tasks have
    true Lumi maps; without them, the control is estimated from the target.
    """

    name: str
    load: tuple[Callable[[], Task], ...]
    true_maps: bool

    def __iter__(self) -> Iterator[Task]:
        return (load() for load in self.load)

    def __len__(self) -> int:
        return len(self.load)

    def first(self, count: int | None) -> Benchmark:
        """Return the benchmark with its first tasks only."""
        return replace(self, load=self.load[:count])
