"""Compare an exported mini with torch. The export fails above a bar; the figures go into the manifest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import torch

from dior_rt.engine import Feeds
from dior_rt.errors import DiorError
from dior_rt.families import Mode, mini
from dior_rt.flow.sampler import Array, Condition, Velocity, draw_noise, guided, sample
from dior_rt.grid import GridRule
from dior_rt.kernels import Strokes

SIGMAS: Final = (1.0, 0.9, 0.5, 0.1, 1e-3)
SEEDS: Final = (0, 1, 2)
# The range of the data variable from black to white.
SPAN: Final[dict[Mode, float]] = {"relight": 4.0, "estimate": 2.0}

Bind = Callable[[Condition], Velocity]


@dataclass(frozen=True)
class Bars:
    """evaluation: the largest error of one evaluation, relative to its largest value. sampling: dB at the
    end."""

    evaluation: float
    sampling: float


class ExportError(DiorError):
    """A checkpoint that cannot be exported, or an export that differs from its source."""


def check_evaluations(network: torch.nn.Module, graphs: mini.Graphs, grid: GridRule, bars: Bars) -> float:
    """Return the largest relative error of one evaluation over sigmas, grids, modes, seeds and hostile
    inputs."""
    worst = 0.0
    for feeds in _all_feeds(grid):
        worst = max(worst, relative_error(run(graphs, feeds), evaluate(network, feeds)))
    if not worst <= bars.evaluation:
        raise ExportError(
            f"The graphs are off by {worst:.2g} of their largest value; {bars.evaluation:g} is allowed."
        )
    return worst


def check_sampling(
    network: torch.nn.Module,
    graphs: mini.Graphs,
    grid: GridRule,
    sigmas: Array,
    guidance: float,
    bars: Bars,
) -> float:
    """Return the lowest PSNR, in dB, between runs of the runtime's sampler with the graphs and with torch."""
    lowest = math.inf
    for size, mode in product((grid.shape(1, 1), grid.shape(2, 3)), SPAN):
        condition = random_condition(*size, mode, seed=size[0])
        torch_s = guided(_bind(network), condition, mini.null(condition), guidance)
        error = _run(graphs.guided(condition, guidance), condition, sigmas) - _run(torch_s, condition, sigmas)
        mean_square = float(np.mean(np.square(error / SPAN[mode], dtype=np.float64)))
        lowest = min(lowest, -10 * math.log10(max(mean_square, 1e-20)))
    if not lowest >= bars.sampling:
        raise ExportError(
            f"After all steps the graphs keep {lowest:.1f} dB to torch; they need {bars.sampling:g}."
        )
    return lowest


def run(graphs: mini.Graphs, feeds: Feeds) -> Array:
    """Return the velocity that the two graphs compute for one evaluation."""
    drawn, _ = graphs.branches(feeds)
    return graphs.velocity.run({"x": feeds["x"], "sigma": feeds["sigma"], **drawn})["velocity"]


def evaluate(network: torch.nn.Module, feeds: Feeds) -> Array:
    """Return the network's velocity in torch as an array. Raises ExportError if it is not finite."""
    with torch.inference_mode():
        velocity = network(**{name: torch.from_numpy(array) for name, array in feeds.items()}).numpy()
    if not np.isfinite(velocity).all():
        raise ExportError("The network computes what is no number; its weights are broken.")
    return velocity


def relative_error(got: Array, want: Array) -> float:
    """Return the largest difference in a batch, relative to the largest value of its row."""
    rows = tuple(range(1, want.ndim))
    return float((np.abs(got - want).max(rows) / np.maximum(np.abs(want).max(rows), 1e-6)).max())


def random_condition(height: int, width: int, mode: Mode, seed: int) -> Condition:
    """Return a noisy photo with strokes of light up to about 5 on a fifth of it."""
    rng = np.random.default_rng(seed)
    photo = rng.random((height, width, 3), dtype=np.float32)
    light = rng.exponential(1.0, (height, width, 3)).astype(np.float32)
    mask = (rng.random((height, width)) < 0.2).astype(np.float32)
    return mini.encode(photo, Strokes(light, mask), mode)


def random_feeds(height: int, width: int, seed: int) -> Feeds:
    """Return the inputs of one evaluation: a batch of both modes at each of SIGMAS."""
    cases = list(product(SPAN, SIGMAS))
    rows = [random_condition(height, width, mode, seed * len(cases) + i) for i, (mode, _) in enumerate(cases)]
    condition = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    sigma = np.array([sigma for _, sigma in cases], np.float32)
    return {"x": draw_noise(seed, condition["photo"].shape), "sigma": sigma, **condition}


def _all_feeds(grid: GridRule) -> Iterator[Feeds]:
    smallest = grid.multiple, grid.multiple
    for size, seed in product((grid.shape(1, 1), grid.shape(2, 3), grid.shape(1, 10**6), smallest), SEEDS):
        yield random_feeds(*size, seed)
    usual = random_feeds(*grid.shape(3, 2), seed=0)
    black, bare = np.zeros_like(usual["photo"]), np.zeros_like(usual["mask"])
    yield {**usual, "mask": bare, "light": black}
    yield {**usual, "mask": bare + 1}
    yield {**usual, "mask": bare + 1, "light": black + 1e4}
    yield {**usual, "photo": black, "mask": bare + 1, "light": black}
    yield {**usual, "x": black, "photo": black, "mask": bare, "light": black}
    yield {**usual, "x": 100 * usual["x"]}


def _run(velocity: Velocity, condition: Condition, sigmas: Array) -> Array:
    *_, last = sample(velocity, draw_noise(1, condition["photo"].shape), sigmas)
    return last.x


def _bind(network: torch.nn.Module) -> Bind:
    def bind(condition: Condition) -> Velocity:
        return lambda x, sigma: evaluate(
            network, {"x": x, "sigma": np.full(len(x), sigma, np.float32), **condition}
        )

    return bind
