"""Make the cases that measure presets: pairs mixed from held-out renders, and strokes of their light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dior_rt.bench.cases import OPS, Case
from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.data.triplets import interest, load_views, pair


def from_renders(folder: Path, count: int) -> list[Case]:
    """Return pairs mixed from a folder of renders.

    Half replace all lights, and half change one. In each half the light is passed whole or as strokes. Needs
    dior-rt[train]. Raises InputError for too few renders.
    """
    views = load_views(folder)
    if len(views) < count:
        raise InputError(f"{folder} has {len(views)} views, fewer than {count}.")
    cases = []
    for number, view in enumerate(views[:count]):
        sample = pair(np.random.default_rng([number, 72]), view, ("replace", "change")[number % 2])
        if number // 2 % 2:
            drawn = Strokes(sample.target, np.ones(sample.target.shape[:2], np.float32))
        else:
            where = interest(sample) if sample.kind == "change" else None
            drawn = OPS.sparsify(sample.target, "strokes", number, interest=where)
        cases.append(Case(OPS.encode_srgb(sample.photo, np.uint8), drawn, number))
    return cases
