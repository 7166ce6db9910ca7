"""The sampler on velocity fields whose flow is known, and the schedules against diffusers'."""

import math

import numpy as np
import pytest

from dior_rt.flow.sampler import between, draw_noise, guide, guided, sample
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule

EVEN = ShiftSchedule(1.0)


def last(states):
    *_, state = states
    return state


def gaussian_velocity(mean, deviation):
    """E[eps - x0 | x] for x0 ~ N(mean, deviation^2), x = (1 - sigma) x0 + sigma eps."""

    def velocity(x, sigma):
        variance = (1 - sigma) ** 2 * deviation**2 + sigma**2
        excess = x - (1 - sigma) * mean
        return (sigma * excess / variance - (mean + (1 - sigma) * deviation**2 * excess / variance)).astype(
            np.float32
        )

    return velocity


def gaussian_end(noise, mean, deviation):
    """Where the flow of `gaussian_velocity` carries noise: it keeps the place in standard deviations."""
    return mean + deviation * noise


def test_flow_of_gaussian_data_reaches_its_closed_form():
    noise = draw_noise(3, (64,))
    end = last(sample(gaussian_velocity(0.4, 0.3), noise, EVEN.sigmas(1000))).x
    np.testing.assert_allclose(end, gaussian_end(noise, 0.4, 0.3), atol=2e-3)


def test_every_state_lies_on_the_gaussian_path():
    noise, mean, deviation = draw_noise(4, (64,)), -0.7, 0.5
    for state in sample(gaussian_velocity(mean, deviation), noise, EVEN.sigmas(1000)):
        s = state.sigma
        path = (1 - s) * mean + math.hypot((1 - s) * deviation, s) * noise
        np.testing.assert_allclose(state.x, path, atol=4e-3)


@pytest.mark.parametrize("steps", [1, 2, 40, 1000])
@pytest.mark.parametrize("shift", [1.0, 8.0])
def test_point_mass_is_reached_exactly_in_any_number_of_steps(steps, shift):
    noise, point = draw_noise(6, (2, 3, 4)), np.float32(0.25)
    state = last(
        sample(lambda x, sigma: (x - point) / np.float32(sigma), noise, ShiftSchedule(shift).sigmas(steps))
    )
    np.testing.assert_allclose(state.x, point, atol=2e-5)
    assert (state.step, state.sigma) == (steps, 0.0)


def test_states_point_at_the_image():
    point = np.float32(-0.5)
    states = list(
        sample(lambda x, sigma: (x - point) / np.float32(sigma), draw_noise(7, (8,)), EVEN.sigmas(5))
    )
    for state in states:
        np.testing.assert_allclose(state.x0, point, atol=1e-6)
    np.testing.assert_array_equal(states[-1].x, states[-1].x0)
    assert [(s.step, s.steps) for s in states] == [(i, 5) for i in range(1, 6)]


def test_state_stays_float32_when_the_network_computes_in_less_or_more():
    for dtype in (np.float16, np.float64):
        state = last(sample(lambda x, sigma, d=dtype: x.astype(d), draw_noise(8, (4,)), EVEN.sigmas(4)))
        assert state.x.dtype == state.x0.dtype == np.float32


def test_the_sampler_leaves_the_noise_alone():
    noise = draw_noise(9, (4,))
    before = noise.copy()
    last(sample(lambda x, sigma: x, noise, EVEN.sigmas(4)))
    np.testing.assert_array_equal(noise, before)


@pytest.mark.parametrize("shift", [1.0, 3.0, 8.0])
@pytest.mark.parametrize("steps", [1, 4, 40])
def test_shift_agrees_with_diffusers(shift, steps):
    torch = pytest.importorskip("torch")
    diffusers = pytest.importorskip("diffusers")
    scheduler = diffusers.FlowMatchEulerDiscreteScheduler(shift=shift)
    scheduler.set_timesteps(sigmas=np.linspace(1.0, 1.0 / steps, steps))
    sigmas = ShiftSchedule(shift).sigmas(steps)
    np.testing.assert_allclose(sigmas, scheduler.sigmas.numpy(), atol=1e-6)

    velocity, noise = gaussian_velocity(0.4, 0.3), draw_noise(10, (3, 5))
    theirs = torch.from_numpy(noise)
    for timestep in scheduler.timesteps:
        v = torch.from_numpy(velocity(theirs.numpy(), float(timestep) / 1000))
        theirs = scheduler.step(v, timestep, theirs).prev_sample
    np.testing.assert_allclose(last(sample(velocity, noise, sigmas)).x, theirs.numpy(), atol=1e-5)


@pytest.mark.parametrize("tokens", [256, 4096, 8192])
@pytest.mark.parametrize("steps", [2, 40])
def test_dynamic_shift_agrees_with_diffusers(tokens, steps):
    diffusers = pytest.importorskip("diffusers")
    scheduler = diffusers.FlowMatchEulerDiscreteScheduler(
        use_dynamic_shifting=True, time_shift_type="exponential", shift_terminal=0.02
    )
    mu = 0.5 + (0.9 - 0.5) * (tokens - 256) / (8192 - 256)
    scheduler.set_timesteps(sigmas=np.linspace(1.0, 1.0 / steps, steps), mu=mu)
    ours = DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02).sigmas(steps, tokens)
    np.testing.assert_allclose(ours, scheduler.sigmas.numpy(), atol=1e-6)


@pytest.mark.parametrize("steps", [1, 2, 40, 1000])
def test_schedules_fall_from_one_to_zero(steps):
    dynamic = DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02)
    for sigmas in (ShiftSchedule(8.0).sigmas(steps), dynamic.sigmas(steps, 4096)):
        assert len(sigmas) == steps + 1 and sigmas.dtype == np.float32
        assert (sigmas[0], sigmas[-1]) == (1.0, 0.0)
        assert (np.diff(sigmas) < 0).all()


@pytest.mark.parametrize("steps", [0, -3])
def test_a_schedule_without_steps_is_refused(steps):
    with pytest.raises(ValueError, match="at least 1 step"):
        EVEN.sigmas(steps)


def test_noise_of_a_seed_is_the_same_for_ever():
    np.testing.assert_array_equal(
        draw_noise(0, (5,)),
        np.array([1.117622, -1.3871249, -0.4265716, -0.80358726, 0.60142773], np.float32),
    )
    assert not np.array_equal(draw_noise(0, (5,)), draw_noise(1, (5,)))


def test_noise_is_standard_normal():
    noise = draw_noise(1, (200_000,)).astype(np.float64)
    moments = noise.mean(), noise.std(), (noise**4).mean()
    np.testing.assert_allclose(moments, (0, 1, 3), atol=0.05)


def test_guidance_is_linear_between_and_beyond_the_branches():
    v_null, v_cond = draw_noise(1, (3, 4)), draw_noise(2, (3, 4))
    np.testing.assert_array_equal(guide(v_null, v_cond, 0.0), v_null)
    np.testing.assert_allclose(guide(v_null, v_cond, 1.0), v_cond, atol=1e-6)
    np.testing.assert_allclose(guide(v_null, v_cond, 4.0), v_null + 4 * (v_cond - v_null), atol=1e-6)


class Network:
    """A velocity that is its condition's field `level`; counts evaluations and their batch."""

    def __init__(self):
        self.batches = []

    def __call__(self, condition):
        def velocity(x, sigma):
            self.batches.append(len(x))
            return np.broadcast_to(condition["level"][:, None], x.shape).astype(np.float32)

        return velocity


@pytest.mark.parametrize(("scale", "batch"), [(0.0, 1), (1.0, 1), (4.0, 2), (0.5, 2)])
def test_guidance_runs_both_branches_in_one_batch_and_one_where_one_is_enough(scale, batch):
    network = Network()
    condition, null = {"level": np.array([3.0])}, {"level": np.array([1.0])}
    v = guided(network, condition, null, scale)(draw_noise(0, (1, 6)), 0.5)
    np.testing.assert_allclose(v, np.full((1, 6), 1 + scale * 2), atol=1e-6)
    assert network.batches == [batch]


@pytest.mark.parametrize(
    ("sigma", "level"), [(1.0, 0.0), (0.81, 0.0), (0.8, 9.0), (0.5, 9.0), (0.3, 9.0), (0.29, 0.0)]
)
def test_guidance_in_an_interval_is_the_condition_alone_outside_of_it(sigma, level):
    def constant(value):
        return lambda x, sigma: np.full_like(x, value)

    v = between(0.3, 0.8, constant(9), constant(0))(draw_noise(0, (4,)), sigma)
    np.testing.assert_array_equal(v, np.full(4, level, np.float32))
