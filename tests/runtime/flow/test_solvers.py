"""The solvers: their orders, known answers, and diffusers' schedulers step by step."""

import numpy as np
import pytest

from dior_rt.flow.sampler import draw_noise, sample
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.flow.solvers import SOLVERS, Point, slope

EVEN = ShiftSchedule(1.0)
MEAN, DEVIATION = 0.4, 0.3


def last(states):
    *_, state = states
    return state


def gaussian_velocity(x, sigma):
    """E[eps - x0 | x] for x0 ~ N(MEAN, DEVIATION^2); its flow carries noise to MEAN + DEVIATION * noise."""
    variance = (1 - sigma) ** 2 * DEVIATION**2 + sigma**2
    excess = x - (1 - sigma) * MEAN
    return ((sigma - (1 - sigma) * DEVIATION**2) * excess / variance - MEAN).astype(np.float32)


class Counted:
    """A velocity that keeps the sigmas at which it was asked."""

    def __init__(self, velocity):
        self.velocity, self.sigmas = velocity, []

    def __call__(self, x, sigma):
        self.sigmas.append(sigma)
        return self.velocity(x, sigma)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_converges_with_its_order(name):
    """From 0.9, on the flow, to 0.1, where lambda is finite. UniPC's corrector wins an order."""
    noise, steps = draw_noise(5, (64,)), np.array([40, 80, 160])

    def on_the_flow(sigma):
        return (1 - sigma) * MEAN + np.hypot((1 - sigma) * DEVIATION, sigma) * noise

    start = on_the_flow(0.9).astype(np.float32)
    errors = []
    for count in steps:
        sigmas = np.linspace(0.9, 0.1, count + 1, dtype=np.float32)
        errors.append(np.abs(last(sample(gaussian_velocity, start, sigmas, name)).x - on_the_flow(0.1)).max())
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(3 if name == "unipc" else SOLVERS[name].order, abs=0.2)


@pytest.mark.parametrize("name", SOLVERS)
def test_from_noise_to_image_twice_the_steps_err_less(name):
    noise = draw_noise(5, (64,))
    errors = [
        np.abs(
            last(sample(gaussian_velocity, noise, EVEN.sigmas(n), name)).x - (MEAN + DEVIATION * noise)
        ).max()
        for n in (64, 128, 256)
    ]
    assert errors[0] > 1.7 * errors[1] > 1.7**2 * errors[2]


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("steps", [1, 2, 3, 40])
@pytest.mark.parametrize("shift", [1.0, 8.0])
def test_straight_lines_are_followed_exactly(name, steps, shift):
    noise, point = draw_noise(6, (2, 3, 4)), np.float32(0.25)
    velocity = Counted(lambda x, sigma: (x - point) / np.float32(sigma))
    state = last(sample(velocity, noise, ShiftSchedule(shift).sigmas(steps), name))
    np.testing.assert_allclose(state.x, point, atol=3e-5)
    np.testing.assert_allclose(state.x0, point, atol=3e-5)
    assert (state.step, state.sigma) == (steps, 0.0)
    assert len(velocity.sigmas) == (steps - 1) * SOLVERS[name].asks + 1
    assert min(velocity.sigmas) > 0


@pytest.mark.parametrize("name", SOLVERS)
def test_the_state_is_float32_whatever_the_network_computes_in_and_the_noise_stays(name):
    noise = draw_noise(8, (4,))
    before = noise.copy()
    for dtype in (np.float16, np.float64):
        states = list(sample(lambda x, sigma, d=dtype: x.astype(d), noise, EVEN.sigmas(4), name))
        assert all(state.x.dtype == state.x0.dtype == np.float32 for state in states)
    np.testing.assert_array_equal(noise, before)


@pytest.mark.parametrize("name", SOLVERS)
def test_noise_of_strength_nothing_is_a_start_as_well(name):
    state = last(sample(gaussian_velocity, np.zeros(3, np.float32), EVEN.sigmas(64), name))
    np.testing.assert_allclose(state.x, MEAN, atol=1e-3)


def test_adams_is_exact_where_the_velocity_is_a_line_in_sigma_but_for_its_first_step():
    sigmas = np.array([1.0, 0.9, 0.5, 0.45, 0.1, 0.0], np.float32)
    x = last(sample(lambda x, sigma: np.full_like(x, 3 * sigma - 1), np.zeros(2), sigmas, "adams")).x
    # The integral of 3 s - 1 from 1 to 0, and the first step's error: 3 / 2 of its length squared.
    np.testing.assert_allclose(x, -(3 / 2 - 1) - 3 / 2 * 0.1**2, atol=1e-6)


def test_a_slope_is_that_between_two_points():
    x = np.zeros(2, np.float32)
    two = Point(0.5, x, np.array([1, 5], np.float32)), Point(0.75, x, np.array([2, 3], np.float32))
    np.testing.assert_allclose(slope(*two), [4, -8])


def theirs(scheduler, noise):
    """What a scheduler of diffusers makes of the Gaussian field."""
    torch = pytest.importorskip("torch")
    x = torch.from_numpy(noise)
    for timestep in scheduler.timesteps:
        v = torch.from_numpy(gaussian_velocity(x.numpy(), float(timestep) / 1000))
        x = scheduler.step(v, timestep, x).prev_sample
    return x.numpy()


@pytest.mark.parametrize("steps", [2, 3, 5, 20])
@pytest.mark.parametrize("shift", [1.0, 3.0])
@pytest.mark.parametrize("name", ["dpmpp-2m", "unipc"])
def test_multistep_methods_agree_with_diffusers(name, steps, shift):
    diffusers = pytest.importorskip("diffusers")
    kinds = {
        "dpmpp-2m": diffusers.DPMSolverMultistepScheduler,
        "unipc": diffusers.UniPCMultistepScheduler,
    }
    scheduler = kinds[name](
        solver_order=2, use_flow_sigmas=True, flow_shift=shift, prediction_type="flow_prediction"
    )
    scheduler.set_timesteps(steps)
    # Timesteps are rounded; the field is asked where the scheduler believes to be.
    scheduler.timesteps = 1000 * scheduler.sigmas[:-1]
    noise = draw_noise(10, (3, 5))
    ours = last(sample(gaussian_velocity, noise, scheduler.sigmas.numpy(), name)).x
    np.testing.assert_allclose(ours, theirs(scheduler, noise), atol=2e-5)


@pytest.mark.parametrize("steps", [2, 5, 20])
@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_heun_agrees_with_diffusers(steps, shift):
    diffusers = pytest.importorskip("diffusers")
    scheduler = diffusers.FlowMatchHeunDiscreteScheduler(shift=shift)
    scheduler.set_timesteps(steps)
    sigmas = np.unique(scheduler.sigmas.numpy())[::-1].copy()
    noise = draw_noise(11, (3, 5))
    ours = last(sample(gaussian_velocity, noise, sigmas, "heun")).x
    np.testing.assert_allclose(ours, theirs(scheduler, noise), atol=2e-5)
