"""Find the benchmarks in a folder by its layout.

renders      {scene}-{view}.npz of `dior-rt train render`
RealBench    realbench.json and {pair}/ of `dior-rt train realbench`
SynthBench   synthbench.json and {pair}/ of `dior-rt train synthbench`
MultiIllum   {scene}/dir_{0..24}_mip{m}.jpg or .exr
ReNe         {scene}/lset{000..039}/data/{00000..00049}_image.png
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from dior_rt.errors import InputError
from dior_rt.images.strokes import read_lumi
from dior_rt.training.data.render import View
from dior_rt.training.data.triplets import Pair, interest, pair
from dior_rt.training.evaluation.judges.realbench import realbench
from dior_rt.training.evaluation.layouts import multi_illum, read_picture, rene
from dior_rt.training.evaluation.tasks import OPS, Benchmark, Task

HEAD: Final = "synthbench.json"
LAST: Final = "target.png"  # the last file of a pair: a pair with it is complete


def open_benchmarks(folder: Path) -> list[Benchmark]:
    """Return the benchmarks in a folder, recognised by their layout. Raises InputError if there are none."""
    for kind in (renders, realbench, synthbench, multi_illum, rene):
        if folder.is_dir() and (found := kind(folder)):
            return found
    raise InputError(
        f"There are no renders in {folder}, and it is laid out like none of RealBench, SynthBench, "
        f"MultiIllum and ReNe; make renders with `dior-rt train render --out {folder}`."
    )


def renders(folder: Path, kinds: Sequence[str] = ("replace", "change"), seed: int = 1) -> list[Benchmark]:
    """Return a pair of every kind from every view: the kinds of triplets, and "add", where a light comes
    on."""
    paths = sorted(folder.glob("*-*.npz"))
    if not paths:
        return []
    return [
        Benchmark(
            kind,
            tuple(partial(_rendered, path, kind, number, seed) for number, path in enumerate(paths)),
            True,
        )
        for kind in kinds
    ]


def _rendered(path: Path, kind: str, number: int, seed: int) -> Task:
    rng, view = np.random.default_rng([number, seed]), View.load(path)
    sample = one_light_more(rng, view) if kind == "add" else pair(rng, view, kind)
    source, truth = (OPS.encode_srgb(linear, np.uint8) for linear in (sample.photo, sample.relit))
    where = interest(sample) if sample.kind == "change" else None
    name = f"{path.stem}-{kind}"
    return Task(name, source, truth, sample.source, sample.target, interest=where, seed=number)


def one_light_more(rng: Generator, view: View, draws: int = 64) -> Pair:
    """Return a random pair with one changed light that only adds light. Raises InputError after `draws`."""
    for _ in range(draws):
        sample = pair(rng, view, "change")
        if (sample.target >= sample.source - 1e-3).all() and not np.array_equal(sample.target, sample.source):
            return sample
    raise InputError(f"The scene {view.seed} has no light that can be added.")


def synthbench(folder: Path) -> list[Benchmark]:
    """Return the pairs that `dior-rt train synthbench` made."""
    if not (folder / HEAD).is_file():
        return []
    pairs = sorted(path.parent for path in folder.glob(f"*/{LAST}"))
    if not pairs:
        raise InputError(
            f"The SynthBench in {folder} has no pairs; render them with `dior-rt train synthbench`."
        )
    load = tuple(partial(_synthesized, path, number) for number, path in enumerate(pairs))
    return [Benchmark("SynthBench", load, True)]


def _synthesized(folder: Path, number: int) -> Task:
    source, truth = read_picture(folder / "source.png"), read_picture(folder / LAST)
    before, after = (read_lumi(folder / f"{name}_lumi.exr") for name in ("source", "target"))
    mask = (read_picture(folder / "mask.png")[..., 0] > 0).astype(np.float32)
    return Task(folder.name, source, truth, before, after, mask=mask, seed=number)
