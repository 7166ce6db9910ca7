"""Adaptive steps: as many as a picture needs to come out within a tolerance.

Adams' and Bashforth's step predicts the state, the velocity there gives the trapezoidal rule's correction of
it, and their distance estimates the error (Milne's device; Hairer, Norsett & Wanner, Solving Ordinary
Differential Equations I, III.7). An estimate costs no evaluation of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from dior_rt.sampler import State, in_float32
from dior_rt.solvers import Array, Point, Velocity, slope

Distance = Callable[[Array, Array], float]  # of two images x0, in the units of the tolerance

FIRST = 1 / 40  # of the way: the first step
LONGER, SHORTER = 3.0, 0.2  # bounds of a step by the one before
MARGIN = 0.9  # of the step that the estimate would allow
RETRY = 0.8  # a step whose successor would be shorter than this share of it is taken again


def sample_within(
    tolerance: float, distance: Distance, velocity: Velocity, noise: Array, sigmas: Array
) -> Iterator[State]:
    """Walk x from `noise` at sigmas[0] to 0 = sigmas[-1], stopping only at as many of the sigmas as needed.

    Each step may err by its share of the way, step / steps, times the tolerance; errors are taken to reach
    the image as large as they arose. The state's `step` counts sigmas passed: it jumps.
    """
    steps, velocity = len(sigmas) - 1, in_float32(velocity)
    here, before = Point(1.0, noise, velocity(noise, 1.0)), None
    at, leap = 0, max(1, round(FIRST * steps))
    while True:
        leap = max(1, min(leap, steps - at))
        sigma = float(sigmas[at + leap])
        h = sigma - here.sigma
        x = here.at(sigma) + (h * h / 2 * slope(here, before) if before else 0)
        if sigma == 0:  # where no velocity is
            yield State(steps, steps, sigma, x, here.x0)
            return
        v = velocity(x, sigma)
        corrected = here.x + h / 2 * (here.v + v)
        x0 = x - sigma * v
        share = tolerance * leap / steps / max(distance(x0 + (corrected - x), x0), np.finfo(np.float32).tiny)
        stretch = min(LONGER, max(SHORTER, MARGIN * math.sqrt(share)))
        if stretch < RETRY and leap > 1:
            leap = int(leap * stretch)
            continue
        at, before, here = at + leap, here, Point(sigma, corrected, v)
        leap = round(leap * stretch)
        yield State(at, steps, sigma, corrected, here.x0)
