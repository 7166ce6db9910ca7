"""A run's rate follows its plan, by steps or by time."""

from __future__ import annotations

import pytest

from dior_rt.training.lumen.clock import Clock


def test_the_rate_warms_up_stays_and_falls_to_zero() -> None:
    clock = Clock(steps=10_000, minutes=None)
    rates = []
    for step in (0, 50, 400, 5_000, 6_500, 8_250, 10_000):
        clock.step = step
        rates.append(clock.rate)
    assert rates[0] < 0.02 < rates[1] < rates[2] == rates[3] == rates[4] == 1
    assert rates[5] == pytest.approx(0.5)
    assert rates[6] == 0


def test_time_decides_where_minutes_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("dior_rt.training.lumen.clock.time.monotonic", lambda: now[0])
    monkeypatch.setattr("dior_rt.training.lumen.clock.seconds_since_start", lambda: now[0] - 100)
    clock = Clock(steps=1, minutes=2)
    for seconds in (
        30,
        0.5,
        0.5,
        44.5,
        44.5,
    ):  # the first three compile and count as setup: 31 of 120 seconds
        now[0] += seconds
        clock.tick()
    assert clock.spent == pytest.approx(89)
    assert clock.done == pytest.approx(1)


def test_a_resumed_run_counts_what_was_done_before() -> None:
    clock = Clock(steps=100, minutes=None, step=40)
    assert (clock.done, clock.taken) == (0.4, 0)
    clock.tick()
    assert (clock.step, clock.taken) == (41, 1)
