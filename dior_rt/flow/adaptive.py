"""Adaptive steps: take as many steps as a picture needs to stay within a tolerance.

The method assumes that the image x0 that the flow points at moves linearly in sigma. With
d(x / sigma) = x0 d(1 / sigma), that gives the state in closed form at every sigma from 1 down to 0; see
`glide`. At the end of a step, the velocity gives the true image. Its distance from the expected image is
the error of the step, in the picture's own units, and the step is corrected by it. The estimate needs no
extra evaluation (Milne's device; Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, III.7).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator

import numpy as np

from dior_rt.flow.sampler import State, in_float32
from dior_rt.flow.solvers import Array, Velocity

Distance = Callable[[Array, Array], float]  # between two images x0, in the units of the tolerance

FIRST = 1 / 40  # the first step, as a share of the way
LONGEST = 1 / 6  # the longest step, as a share of the way: nothing within a step is measured
LONGER, SHORTER = 2.0, 0.2  # bounds of a step relative to the one before
MARGIN = 0.9  # share of the step that the estimate would allow
RETRY = 0.8  # a step is repeated if the next one would be shorter than this share of it


def sample_within(
    tolerance: float, distance: Distance, velocity: Velocity, noise: Array, sigmas: Array
) -> Iterator[State]:
    """Walk x from `noise` at sigmas[0] to 0 = sigmas[-1], stopping at as few of the sigmas as needed.

    The error of each step may be its share of the way, step / steps, times the tolerance. The method
    assumes that errors reach the end undiminished. The state's `step` counts the sigmas passed, so it
    jumps. The last step leads to 0, where there is no velocity; it is as short as the schedule's last step,
    and straight.
    """
    velocity, steps = in_float32(velocity), len(sigmas) - 1
    sigma, x, at, leap = float(sigmas[0]), noise, 0, max(1, round(FIRST * steps))
    x0 = x - sigma * velocity(x, sigma)
    drift: Array = np.zeros_like(x0)
    while at < steps - 1:
        leap = min(leap, steps - 1 - at)
        then = float(sigmas[at + leap])
        expected = x0 + (then - sigma) * drift
        ahead = glide(x, x0, drift, sigma, then)
        found = ahead - then * velocity(ahead, then)
        error = weight(sigma, then) * distance(found, expected)
        share = tolerance * leap / steps / max(error, sys.float_info.min)
        stretch = min(LONGER, max(SHORTER, MARGIN * math.sqrt(share)))
        if stretch < RETRY and leap > 1:
            leap = max(1, int(leap * stretch))
            continue
        drift = (found - x0) * np.float32(1 / (then - sigma))
        x = glide(x, x0, drift, sigma, then)
        sigma, x0, at = then, found, at + leap
        leap = max(1, min(round(leap * stretch), round(LONGEST * steps)))
        yield State(at, steps, sigma, x, x0)
    yield State(steps, steps, 0.0, x0, x0)


def glide(x: Array, x0: Array, drift: Array, sigma: float, then: float) -> Array:
    """Return the state at sigma' = `then` > 0 if the image moves from x0 by `drift` per unit of sigma:

    x' = r x + (1 - r) x0 + w (sigma' - sigma) drift,    r = sigma' / sigma,  w = `weight`
    """
    r = then / sigma
    return r * x + (1 - r) * x0 + weight(sigma, then) * (then - sigma) * drift


def weight(sigma: float, then: float) -> float:
    """Return the share of the image's movement in a step that reaches the state: 1 + r log(r) / (1 - r).

    It is (1 - r) / 2 for short steps, and 1 for one that ends at 0.
    """
    r = then / sigma
    return 1 + r * math.log(r) / (1 - r)
