"""Sampler: one step and a thousand, sigma next to 0 and 1, strong guidance, stiff fields.

Every solver walks velocity fields with a known flow: E[eps - x0 | x] of wide and narrow Gaussians, of one
point, and of two slightly blurred points. The result is compared with float64. An order is the slope of log
error over log steps, even in sigma, from 320 steps to 1280.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import twin

from dior_rt.families.qwen.model import rescaled
from dior_rt.flow.sampler import draw_noise, guide, guided, sample
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule
from dior_rt.flow.solvers import MEMORY, SOLVERS

NOISE = draw_noise(3, (256,))
EVEN = ShiftSchedule(1.0)


def last(states):
    *_, state = states
    return state.x


def gaussian(mean: float, deviation: float) -> Callable:
    """The velocity of data from N(mean, deviation^2), computed in float64; float32 where x is."""

    def velocity(x, sigma):
        variance = (1 - sigma) ** 2 * deviation**2 + sigma**2
        excess = x.astype(np.float64) - (1 - sigma) * mean
        v = sigma * excess / variance - (mean + (1 - sigma) * deviation**2 * excess / variance)
        return v.astype(x.dtype)

    return velocity


def two_points(blur: float) -> Callable:
    """The velocity of data at -1 and 1, each N(., blur^2): smooth, and stiff where the flow decides."""

    def velocity(x, sigma):
        wide = x.astype(np.float64)
        variance = (1 - sigma) ** 2 * blur**2 + sigma**2
        side = np.tanh((1 - sigma) * wide / variance)
        x0 = side + (1 - sigma) * blur**2 * (wide - (1 - sigma) * side) / variance
        eps = sigma * (wide - (1 - sigma) * side) / variance
        return (eps - x0).astype(x.dtype)

    return velocity


def in_float64(name: str, velocity: Callable, noise: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """The same solver with a float64 state."""
    x, past = noise.astype(np.float64), ()
    for sigma, then in pairwise(sigmas.astype(np.float64).tolist()):
        x, start = SOLVERS[name].step(velocity, x, sigma, then, past)
        past = (start, *past)[:MEMORY]
    return x


def runge_kutta(velocity: Callable, x: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """The classical method of order 4, in float64."""
    for a, b in pairwise(sigmas.tolist()):
        h, middle = b - a, (a + b) / 2
        k1 = velocity(x, a)
        k2 = velocity(x + h / 2 * k1, middle)
        k3 = velocity(x + h / 2 * k2, middle)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(x + h * k3, b))
    return x


@pytest.mark.parametrize("steps", [1, 2, 40, 1000])
@pytest.mark.parametrize("shift", [1e-3, 1.0, 8.0, 1e4])
def test_schedule(hold, shift, steps):
    sigmas = ShiftSchedule(shift).sigmas(steps)
    assert (np.diff(sigmas) < 0).all()
    hold(f"schedule, shift {shift:g}", "fp32", sigmas, twin.shift_sigmas(shift, steps), 6e-8, "sigma")


@pytest.mark.parametrize("shift", [0.0, -1.0, 2e4, np.inf, np.nan])
def test_a_shift_that_float32_cannot_follow_is_refused(shift):
    with pytest.raises(ValueError, match="shift must be"):
        ShiftSchedule(shift)


@pytest.mark.parametrize("tokens", [16, 4096, 100_000])
@pytest.mark.parametrize("steps", [1, 2, 1000])
def test_dynamic_schedule(steps, tokens):
    sigmas = DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02).sigmas(steps, tokens)
    assert np.isfinite(sigmas).all() and (np.diff(sigmas) < 0).all()
    assert (sigmas[0], sigmas[-1]) == (1, 0)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("steps", [1, 1000])
@pytest.mark.parametrize("shift", [1e-3, 1.0, 8.0, 1e4])
def test_one_point_with_sigma_next_to_0_and_1(hold, solver, shift, steps):
    """v = (x - x0) / sigma, as stiff as can be: every step of every solver points at the same image."""
    point = np.float32(0.25)
    got = last(
        sample(lambda x, s: (x - point) / np.float32(s), NOISE, ShiftSchedule(shift).sigmas(steps), solver)
    )
    hold(f"one point, {steps} steps, shift {shift:g}", solver, got, np.full_like(got, point), 2e-5, "x")


@pytest.mark.parametrize("solver", SOLVERS)
def test_sums_over_1000_steps(hold, solver):
    """A constant velocity, and a Gaussian's: what float32 loses in a thousand additions."""
    sigmas = ShiftSchedule(8.0).sigmas(1000)
    third = np.float32(1 / 3)
    got = last(sample(lambda x, s: np.full_like(x, third), NOISE, sigmas, solver))
    hold("constant velocity, 1000 steps", solver, got, NOISE.astype(float) - third, 1e-5, "x")
    field = gaussian(0.4, 0.3)
    want = in_float64(solver, field, NOISE, sigmas)
    hold("Gaussian, 1000 steps", solver, last(sample(field, NOISE, sigmas, solver)), want, 2e-5, "x")


def test_euler_is_the_twins(hold):
    for steps in (1, 40, 1000):
        sigmas = EVEN.sigmas(steps)
        want = twin.euler(gaussian(0.4, 0.3), NOISE, sigmas)
        np.testing.assert_allclose(in_float64("euler", gaussian(0.4, 0.3), NOISE, sigmas), want, atol=1e-13)


FIELDS = {
    "Gaussian 0.3": gaussian(0.4, 0.3),
    "Gaussian 0.03": gaussian(0.4, 0.03),
    "two points": two_points(0.3),
}


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_order_of_convergence(hold, solver, field):
    """In float64, for float32 ends it at 1e-6; from sigma 0.95 to 0.02, for at the ends no step is small to a
    solver that is linear in log((1 - sigma) / sigma)."""
    velocity, noise = FIELDS[field], NOISE.astype(np.float64)
    exact = runge_kutta(velocity, noise, np.linspace(0.95, 0.02, 4000))
    steps = np.array([320, 640, 1280])
    ends = [in_float64(solver, velocity, noise, np.linspace(0.95, 0.02, n + 1)) for n in steps]
    slope = -np.polyfit(np.log(steps), np.log([np.abs(end - exact).max() for end in ends]), 1)[0]
    order = SOLVERS[solver].order
    hold(f"slope on {field}", solver, min(slope, order), order, 0.3, "order", shown=f"{slope:.2f}")


@pytest.mark.parametrize("scale", [0.0, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("apart", [1.0, 1e-3])
def test_guidance(hold, scale, apart):
    """Rounding grows with the scale, not beyond it, also where the branches nearly agree."""
    null = 1e3 * draw_noise(1, (64, 16))
    cond = null + np.float32(apart) * draw_noise(2, (64, 16))
    want = null.astype(np.float64) + scale * (cond.astype(np.float64) - null)
    got = guide(null, cond, scale)
    hold(
        f"guidance {scale:g}",
        "fp32",
        got,
        want,
        1.2e-7,
        "(1 + s) largest v",
        (1 + scale) * np.abs(null).max(),
    )


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("scale", [0.0, 1.0, 4.0, 30.0])
def test_guided_flow(hold, solver, scale):
    """Guidance between two Gaussians of one width is a Gaussian's flow again."""
    fields = {"cond": gaussian(0.5, 0.3), "null": gaussian(-0.5, 0.3)}

    def bind(condition):
        names = {0.0: "null", 1.0: "cond"}

        def velocity(x, sigma):
            rows = [
                fields[names[float(level)]](row, sigma)
                for level, row in zip(condition["level"], x, strict=True)
            ]
            return np.stack(rows)

        return velocity

    sigmas = ShiftSchedule(8.0).sigmas(40)
    velocity = guided(bind, {"level": np.ones(1)}, {"level": np.zeros(1)}, scale)
    got = last(sample(velocity, NOISE[None], sigmas, solver))
    want = in_float64(solver, gaussian(-0.5 + scale, 0.3), NOISE[None], sigmas)
    hold(f"guided flow, guidance {scale:g}", solver, got, want, 1e-6, "(1 + s)", 1 + scale)


MAGNITUDES = [0.0, 1e-45, 1e-38, 1e-25, 1.0, 1e19, 1e30]


@pytest.mark.parametrize("like", MAGNITUDES)
@pytest.mark.parametrize("magnitude", MAGNITUDES)
def test_norm_rescale(hold, magnitude, like):
    """Each token's direction from one, its norm from the other; a norm of 0 stays 0."""
    v = draw_noise(1, (8, 16)).astype(np.float64) * magnitude
    wanted = draw_noise(2, (8, 16)).astype(np.float64) * like
    v, wanted = v.astype(np.float32), wanted.astype(np.float32)
    v[3] = wanted[5] = 0
    norm = np.linalg.norm(v.astype(np.float64), axis=-1, keepdims=True)
    norms = np.linalg.norm(wanted.astype(np.float64), axis=-1, keepdims=True)
    want = np.divide(v, norm, out=np.zeros_like(norm + v), where=norm > 0) * norms
    with np.errstate(all="raise", under="ignore"):
        got = rescaled(v, wanted)
    assert got.dtype == np.float32
    smallest = np.finfo(np.float32).tiny
    hold(f"norm rescale to {like:g}", "fp32", got, want, 1e-6, "norm", np.maximum(norms, smallest))
