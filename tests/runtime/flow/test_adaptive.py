"""Steps that follow a tolerance: on fields whose flow is known."""

import numpy as np
import pytest

from dior_rt.flow.adaptive import glide, sample_within, weight
from dior_rt.flow.sampler import draw_noise
from dior_rt.flow.schedule import ShiftSchedule

SIGMAS = ShiftSchedule(8.0).sigmas(1000)


def rms(one, other):
    return float(np.sqrt(np.mean((one - other).astype(np.float64) ** 2)))


def walk(velocity, noise, tolerance, sigmas=SIGMAS):
    """The states, and the sigmas at which the velocity was asked."""
    asked = []

    def counted(x, sigma):
        asked.append(sigma)
        return velocity(x, sigma)

    return list(sample_within(tolerance, rms, counted, noise, sigmas)), asked


def gaussian(mean, deviation):
    """The flow to N(mean, deviation^2), which carries noise to mean + deviation * noise."""

    def velocity(x, sigma):
        variance = (1 - sigma) ** 2 * deviation**2 + sigma**2
        excess = x - (1 - sigma) * mean
        return ((sigma - (1 - sigma) * deviation**2) * excess / variance - mean).astype(np.float32)

    return velocity


@pytest.mark.parametrize("deviation", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_the_end_errs_less_than_the_tolerance(deviation, tolerance):
    noise = draw_noise(1, (256,))
    states, _ = walk(gaussian(0.4, deviation), noise, tolerance)
    assert rms(states[-1].x, 0.4 + deviation * noise) <= tolerance


def test_a_smaller_tolerance_takes_more_steps_and_errs_less():
    noise = draw_noise(2, (256,))
    counts, errors = [], []
    for tolerance in (1e-1, 1e-2, 1e-3, 1e-4):
        states, _ = walk(gaussian(-0.2, 0.4), noise, tolerance)
        counts.append(len(states))
        errors.append(rms(states[-1].x, -0.2 + 0.4 * noise))
    assert counts == sorted(set(counts)) and errors == sorted(set(errors), reverse=True)
    assert counts[0] <= 40 and counts[-1] <= 400


def test_straight_lines_take_as_few_steps_as_the_bounds_allow():
    point = np.float32(0.25)
    states, asked = walk(lambda x, sigma: (x - point) / np.float32(sigma), draw_noise(3, (16,)), 1e-4)
    np.testing.assert_allclose(states[-1].x, point, atol=1e-4)
    # Of a thousand: 25, then twice as many each time but 167 at most, and the last one alone.
    assert [state.step for state in states] == [25, 75, 175, 342, 509, 676, 843, 999, 1000]
    assert len(asked) == 9 and min(asked) > 0


def test_a_sudden_turn_of_the_image_is_met_with_steps_taken_again():
    """The image moves from 1 to 0 within some 2 % of sigma, wherever the state is."""

    def image(sigma):
        return 0.5 + 0.5 * np.tanh((sigma - 0.5) / 0.01)

    def velocity(x, sigma):
        return ((x - image(sigma)) / sigma).astype(np.float32)

    states, asked = walk(velocity, np.zeros(4, np.float32), 1e-2, ShiftSchedule(1.0).sigmas(1000))
    assert len(asked) > len(states)
    np.testing.assert_allclose(states[-1].x, 0, atol=1e-2)
    # d(x / sigma) = x0 d(1 / sigma), summed finely, at every stop.
    fine = np.linspace(1, 0.2, 200_001)
    middle, inverse = (fine[1:] + fine[:-1]) / 2, np.diff(1 / fine)
    exact = np.append(0, np.cumsum(image(middle) * inverse)) * fine
    for state in states:
        if state.sigma > 0.2:
            assert state.x[0] == pytest.approx(np.interp(-state.sigma, -fine, exact), abs=1e-2)
    leaps = np.diff([0] + [state.step for state in states])
    near = [leap for leap, state in zip(leaps, states, strict=True) if abs(state.sigma - 0.5) < 0.02]
    assert max(near) < leaps.max() / 3


@pytest.mark.parametrize("then", [0.69, 0.3, 1e-3])
def test_gliding_is_the_integral_for_an_image_on_a_line(then):
    sigma, x, x0, drift = 0.7, 0.9, -0.2, 1.5
    fine = np.linspace(sigma, then, 2_000_001)
    middle = (fine[1:] + fine[:-1]) / 2
    exact = then * (x / sigma + np.sum((x0 + (middle - sigma) * drift) * np.diff(1 / fine)))
    assert glide(np.float64(x), np.float64(x0), np.float64(drift), sigma, then) == pytest.approx(
        exact, abs=1e-6
    )


def test_the_weight_runs_from_half_a_short_step_to_all_of_the_last():
    assert weight(0.5, 0.499) == pytest.approx(0.001, rel=1e-2)
    assert weight(1.0, 1e-9) == pytest.approx(1.0, abs=1e-6)


def test_states_go_forward_over_the_schedule_and_point_at_the_image():
    states, _ = walk(gaussian(0.4, 0.3), draw_noise(4, (64,)), 1e-3)
    steps = [state.step for state in states]
    assert steps == sorted(set(steps)) and steps[-1] == 1000
    assert all(state.steps == 1000 and state.sigma == SIGMAS[state.step] for state in states)
    assert all(state.x.dtype == state.x0.dtype == np.float32 for state in states)


def test_a_tolerance_beyond_reach_takes_every_step_and_ends():
    states, _ = walk(gaussian(0.4, 0.3), draw_noise(5, (8,)), 1e-12, ShiftSchedule(8.0).sigmas(40))
    assert [state.step for state in states] == list(range(1, 41))


def test_one_step_is_a_flow_too():
    states, asked = walk(gaussian(0.4, 0.3), draw_noise(6, (8,)), 1e-2, ShiftSchedule(8.0).sigmas(1))
    assert [state.step for state in states] == [1] and asked == [1.0]
