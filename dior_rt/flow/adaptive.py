"""Adaptive steps: as many as a picture needs to come out within a tolerance.

The image x0 that the flow points at is taken to move on a line in sigma. With d(x / sigma) = x0 d(1 / sigma)
that gives the state in closed form at every sigma from 1 down to 0; see `glide`. At the end of a step the
velocity says where the image is in truth: how far from where it was expected is the step's error, in the
picture's own units, and the step is corrected by it. The estimate costs no evaluation of its own (Milne's
device; Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, III.7).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator

import numpy as np

from dior_rt.flow.sampler import State, in_float32
from dior_rt.flow.solvers import Array, Velocity

Distance = Callable[[Array, Array], float]  # of two images x0, in the units of the tolerance

FIRST = 1 / 40  # of the way: the first step
LONGEST = 1 / 6  # of the way: what happens within a step goes unseen
LONGER, SHORTER = 2.0, 0.2  # bounds of a step by the one before
MARGIN = 0.9  # of the step that the estimate would allow
RETRY = 0.8  # a step whose successor would be shorter than this share of it is taken again


def sample_within(
    tolerance: float, distance: Distance, velocity: Velocity, noise: Array, sigmas: Array
) -> Iterator[State]:
    """Walk x from `noise` at sigmas[0] to 0 = sigmas[-1], stopping only at as many of the sigmas as needed.

    Each step may err by its share of the way, step / steps, times the tolerance; errors are taken to reach
    the end as large as they arose. The state's `step` counts sigmas passed: it jumps. The last step, to 0
    where there is no velocity, is as short as the schedule's own and goes straight.
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
    """The state at sigma' = `then` > 0 where the image moves from x0 by `drift` a unit of sigma:

    x' = r x + (1 - r) x0 + w (sigma' - sigma) drift,    r = sigma' / sigma,  w = `weight`
    """
    r = then / sigma
    return r * x + (1 - r) * x0 + weight(sigma, then) * (then - sigma) * drift


def weight(sigma: float, then: float) -> float:
    """The share of the image's movement in a step that reaches the state: 1 + r log(r) / (1 - r).

    It is (1 - r) / 2 for short steps, and 1 for one that ends at 0.
    """
    r = then / sigma
    return 1 + r * math.log(r) / (1 - r)
