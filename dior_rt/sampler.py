"""The sampler: from noise to image along the flow, one Euler step a time.

sigma is flow time, 1 = noise and 0 = image: x = (1 - sigma) x0 + sigma eps, and the velocity is
v = dx/dsigma = eps - x0. The state is float32 whatever the network computes in. `sample` is a generator:
progress, previews and cancelling belong to the caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Condition = Mapping[str, NDArray]  # what the network sees besides x and sigma; its arrays lead with the batch
Velocity = Callable[[Array, float], Array]  # (x, sigma) -> v, of x's shape


@dataclass(frozen=True)
class State:
    """Where the sampler stands after `step` of `steps`: its state x, and the image x0 that it points at."""

    step: int
    steps: int
    sigma: float
    x: Array
    x0: Array


def draw_noise(seed: int, shape: tuple[int, ...]) -> Array:
    """Standard normal noise, drawn on the host by NumPy's PCG64: a seed means the same on every device."""
    return np.random.Generator(np.random.PCG64(seed)).standard_normal(shape, dtype=np.float32)


def guide(v_null: Array, v_cond: Array, scale: float) -> Array:
    """Classifier-free guidance, v_null + scale (v_cond - v_null) (Ho & Salimans, arXiv 2207.12598)."""
    return v_null + np.float32(scale) * (v_cond - v_null)


def guided(
    bind: Callable[[Condition], Velocity], condition: Condition, null: Condition, scale: float
) -> Velocity:
    """The guided velocity. `bind` readies the network for a condition; both branches run as one batch.

    Scale 1 is the condition alone and scale 0 the null alone: they cost one branch.
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


def euler(x: Array, v: Array, sigma: float, sigma_next: float) -> Array:
    """One step of Euler's method, in float32."""
    return x + np.float32(sigma_next - sigma) * v.astype(np.float32, copy=False)


def sample(velocity: Velocity, noise: Array, sigmas: Array) -> Iterator[State]:
    """Walk x from `noise` at sigmas[0] to sigmas[-1], yielding the state after every step."""
    x, steps = noise.astype(np.float32, copy=False), len(sigmas) - 1
    for step, (sigma, sigma_next) in enumerate(pairwise(sigmas.tolist()), start=1):
        v = velocity(x, sigma)
        x, x0 = euler(x, v, sigma, sigma_next), euler(x, v, sigma, 0.0)
        yield State(step, steps, sigma_next, x, x0)
