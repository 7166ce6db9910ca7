"""The sampler: walk from noise to image along the flow, with one of the solvers.

sigma is flow time, 1 = noise and 0 = image: x = (1 - sigma) x0 + sigma eps, and the velocity is
v = dx/dsigma = eps - x0. The state is float32, whatever dtype the network computes in. `sample` is a
generator: the caller handles progress, previews and cancelling.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dior_rt.flow.solvers import MEMORY, SOLVERS, Array, Past, Velocity

Condition = Mapping[str, NDArray]  # inputs besides x and sigma; the first axis is the batch


@dataclass(frozen=True)
class State:
    """The sampler after `step` of `steps`: its state x, and the image x0 that the flow points at."""

    step: int
    steps: int
    sigma: float
    x: Array
    x0: Array


def draw_noise(seed: int, shape: tuple[int, ...]) -> Array:
    """Return standard normal noise, drawn on the host by NumPy's PCG64: the same for a seed on every
    device."""
    return np.random.Generator(np.random.PCG64(seed)).standard_normal(shape, dtype=np.float32)


def guide(v_null: Array, v_cond: Array, scale: float) -> Array:
    """Return v_null + scale (v_cond - v_null): classifier-free guidance (Ho & Salimans, arXiv 2207.12598)."""
    return v_null + np.float32(scale) * (v_cond - v_null)


def guided(
    bind: Callable[[Condition], Velocity], condition: Condition, null: Condition, scale: float
) -> Velocity:
    """Return the guided velocity. `bind` prepares the network for a condition; both branches run as one
    batch.

    Scale 1 uses the condition alone, and scale 0 the null branch alone. Both cost one branch.
    """
    if scale == 1:
        return bind(condition)
    if scale == 0:
        return bind(null)
    both = bind({name: np.concatenate([null[name], condition[name]]) for name in condition})

    def velocity(x: Array, sigma: float) -> Array:
        v_null, v_cond = np.split(both(np.concatenate([x, x]), sigma), 2)
        return guide(v_null, v_cond, scale)

    return velocity


def between(low: float, high: float, inside: Velocity, outside: Velocity) -> Velocity:
    """Return `inside` where low <= sigma <= high, and `outside` elsewhere.

    For guidance in an interval (arXiv 2404.07724), pass the guided velocity as `inside` and the conditional
    one as `outside`.
    """

    def velocity(x: Array, sigma: float) -> Array:
        return inside(x, sigma) if low <= sigma <= high else outside(x, sigma)

    return velocity


def sample(velocity: Velocity, noise: Array, sigmas: Array, solver: str = "euler") -> Iterator[State]:
    """Walk x from `noise` at sigmas[0] to sigmas[-1], yielding the state after every step.

    solver: a name in `SOLVERS`. Raises KeyError for other names.
    """
    method, steps = SOLVERS[solver], len(sigmas) - 1
    velocity = in_float32(velocity)
    x = noise.astype(np.float32, copy=False)
    past: Past = ()
    for step, (sigma, then) in enumerate(pairwise(sigmas.tolist()), start=1):
        x, start = method.step(velocity, x, sigma, then, past)
        past = (start, *past)[:MEMORY]
        yield State(step, steps, then, x, start.x0)


def in_float32(velocity: Velocity) -> Velocity:
    """Return the velocity in float32, whatever dtype the network computes in."""
    return lambda x, sigma: velocity(x, sigma).astype(np.float32, copy=False)
