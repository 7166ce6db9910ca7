"""Solvers: one step along the flow dx/dsigma = v(x, sigma), from a sigma to a smaller one.

A step is a pure function of the state, the two sigmas, and the points where the velocity was evaluated
before. Every method is Euler's step with a better velocity or, equivalently, towards a better image D:
x + (sigma' - sigma) (x - D) / sigma. `SOLVERS` lists all methods.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Velocity = Callable[[Array, float], Array]  # (x, sigma) -> v, of x's shape; sigma > 0


@dataclass(frozen=True)
class Point:
    """An evaluation of the velocity: sigma, the state x, and v(x, sigma)."""

    sigma: float
    x: Array
    v: Array

    def at(self, sigma: float) -> Array:
        """Return the state at another sigma on the straight line through this point."""
        return self.x + (sigma - self.sigma) * self.v

    @property
    def x0(self) -> Array:
        """The image at the end of that line."""
        return self.at(0.0)


Past = tuple[Point, ...]  # the last points, newest first
Step = Callable[[Velocity, Array, float, float, Past], tuple[Array, Point]]

MEMORY: Final = 2  # how many points a step looks back at


@dataclass(frozen=True)
class Solver:
    """A method.

    step: (velocity, x, sigma, sigma', past) -> (x at sigma', the point it started from).
    asks: evaluations of the velocity per step; the step that reaches sigma' = 0 may need fewer.
    order: the least order of convergence.
    """

    step: Step
    order: int
    asks: int = 1


def euler(velocity: Velocity, x: Array, sigma: float, then: float, past: Past) -> tuple[Array, Point]:
    """Euler's method, which is DDIM for flows: one straight step."""
    here = Point(sigma, x, velocity(x, sigma))
    return here.at(then), here


def heun(velocity: Velocity, x: Array, sigma: float, then: float, past: Past) -> tuple[Array, Point]:
    """Heun's method: the mean of the velocities at both ends (Karras et al., arXiv 2206.00364, algorithm 1).

    At sigma' = 0 the velocity is not defined, so the last step is Euler's.
    """
    here = Point(sigma, x, velocity(x, sigma))
    if then == 0:
        return here.at(then), here
    ahead = here.at(then)
    return x + (then - sigma) / 2 * (here.v + velocity(ahead, then)), here


def adams(velocity: Velocity, x: Array, sigma: float, then: float, past: Past) -> tuple[Array, Point]:
    """Two-step Adams-Bashforth with steps of any length: the velocity is extrapolated linearly in sigma."""
    here = Point(sigma, x, velocity(x, sigma))
    if not past:
        return here.at(then), here
    step = then - sigma
    return here.at(then) + step * step / 2 * slope(here, past[0]), here


def dpmpp_2m(velocity: Velocity, x: Array, sigma: float, then: float, past: Past) -> tuple[Array, Point]:
    """DPM-Solver++(2M): the image x0 is extrapolated linearly in lambda = log((1 - sigma) / sigma).

    See arXiv 2211.01095. lambda is infinite at sigma 1 and 0; there the extrapolation is constant, Euler's
    step.
    """
    here = Point(sigma, x, velocity(x, sigma))
    return _dpmpp_2m(here, then, past), here


def unipc(velocity: Velocity, x: Array, sigma: float, then: float, past: Past) -> tuple[Array, Point]:
    """UniPC of order 2 with B(h) = e^h - 1 (arXiv 2302.04867).

    DPM-Solver++(2M) predicts. The velocity at the prediction also corrects the step that led there, without
    another evaluation.
    """
    x0 = Point(sigma, x, velocity(x, sigma)).x0
    if past:
        x = _correct(x0, sigma, past)
    here = Point(sigma, x, (x - x0) / sigma)
    return _dpmpp_2m(here, then, past), here


SOLVERS: Final = {
    "euler": Solver(euler, order=1),
    "heun": Solver(heun, order=2, asks=2),
    "adams": Solver(adams, order=2),
    "dpmpp-2m": Solver(dpmpp_2m, order=2),
    "unipc": Solver(unipc, order=2),
}


def slope(here: Point, before: Point) -> Array:
    """Return the change of the velocity per unit of sigma between two points."""
    return (here.v - before.v) / (here.sigma - before.sigma)


def _dpmpp_2m(here: Point, then: float, past: Past) -> Array:
    if not past or past[0].sigma == 1 or then == 0:
        return here.at(then)
    h, before = _log_snr(then) - _log_snr(here.sigma), _log_snr(here.sigma) - _log_snr(past[0].sigma)
    image = here.x0 + h / (2 * before) * (here.x0 - past[0].x0)
    return _towards(image, here, then)


def _correct(x0: Array, sigma: float, past: Past) -> Array:
    """UniC: return the state at sigma after a step from past[0] that also uses the image x0 at sigma."""
    start = past[0]
    if len(past) == 1:
        return _towards(0.5 * (start.x0 + x0), start, sigma)
    # The images at past[1], past[0] and sigma are weighted so that lines and parabolas in lambda are exact:
    # equations 10 and 11 of the paper. h and r are infinite at sigma = 1.
    h = _log_snr(sigma) - _log_snr(start.sigma)
    r = (_log_snr(past[1].sigma) - _log_snr(start.sigma)) / h
    scale = math.expm1(-h)
    phi_2 = scale / -h - 1
    first, second = phi_2 / scale, 2 * (phi_2 / -h - 0.5) / scale
    old = (second - first) / (r - 1)
    image = start.x0 + old / r * (past[1].x0 - start.x0) + (first - old) * (x0 - start.x0)
    return _towards(image, start, sigma)


def _towards(image: Array, start: Point, then: float) -> Array:
    """Return Euler's step from a point towards another image."""
    return start.x + (then - start.sigma) / start.sigma * (start.x - image)


def _log_snr(sigma: float) -> float:
    """Return lambda = log((1 - sigma) / sigma), for sigma > 0."""
    return math.log((1 - sigma) / sigma) if sigma < 1 else -math.inf
