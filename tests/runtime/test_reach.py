"""Light that stays near the strokes."""

import numpy as np
import pytest

from dior_rt.reach import closeness, within_reach

RNG = np.random.default_rng(5)
SHAPE = (24, 36)


def cells(*at):
    drawn = np.zeros(SHAPE, bool)
    for row, column in at:
        drawn[row, column] = True
    return drawn


@pytest.mark.parametrize("reach", [1e-3, 0.05, 0.3, 4.0])
def test_closeness_is_that_of_the_nearest_cell_drawn(reach):
    """Against all distances, one by one, in float64."""
    drawn = RNG.random(SHAPE) < 0.02
    places = np.argwhere(np.ones(SHAPE, bool))
    distance = np.hypot(*(places[:, None] - np.argwhere(drawn)).transpose(2, 0, 1)).min(axis=1)
    wanted = np.exp(-((distance / (reach * 36)) ** 2)).reshape(SHAPE)
    np.testing.assert_allclose(closeness(drawn, reach), wanted, rtol=1e-5, atol=1e-12)


def test_closeness_turns_and_mirrors_with_the_strokes():
    drawn = cells((3, 4), (10, 30), (20, 9))
    whole = closeness(drawn, 0.2)
    np.testing.assert_array_equal(closeness(drawn.T, 0.2), whole.T)
    np.testing.assert_array_equal(closeness(drawn[::-1, ::-1], 0.2), whole[::-1, ::-1])


def test_a_longer_reach_and_more_strokes_change_no_cell_less():
    few, many = cells((3, 4)), cells((3, 4), (20, 30))
    assert (closeness(few, 0.2) <= closeness(few, 0.3)).all()
    assert (closeness(few, 0.2) <= closeness(many, 0.2)).all()
    assert not closeness(cells(), 0.2).any()


def test_what_is_drawn_keeps_the_models_light_and_what_is_far_the_photos():
    source, relit = RNG.random((2, *SHAPE, 3), np.float32)
    mask = np.where(cells((12, 3)), np.float32(0.01), 0)  # a cell that a stroke just touches
    near = within_reach(source, relit, mask, 0.1)
    np.testing.assert_allclose(near[12, 3], relit[12, 3], atol=1e-6)
    np.testing.assert_allclose(near[:, 25:], source[:, 25:], atol=1e-6)
    low, high = np.minimum(source, relit), np.maximum(source, relit)
    assert (near >= low - 1e-6).all() and (near <= high + 1e-6).all()


def test_light_is_never_below_none():
    source = RNG.random((*SHAPE, 3), np.float32)
    dark = within_reach(source, np.zeros_like(source), np.ones(SHAPE, np.float32), 0.3)
    assert dark.min() >= 0 and dark.max() < 1e-6


def test_light_fades_as_a_ratio():
    """At the reach exp(-1) of the ratio's logarithm is left, in every channel."""
    source = np.full((1, 50, 3), 0.2, np.float32)
    relit = np.broadcast_to(np.float32([0.9, 0.2, 0.0]), source.shape)
    mask = np.eye(1, 50, dtype=np.float32)
    left = np.log((within_reach(source, relit, mask, 0.1)[0, 5] + 0.02) / 0.22)
    np.testing.assert_allclose(left, np.exp(-1) * np.log((relit[0, 5] + 0.02) / 0.22), rtol=1e-5, atol=1e-6)


def test_a_map_that_speaks_everywhere_is_not_touched():
    source, relit = RNG.random((2, *SHAPE, 3), np.float32)
    np.testing.assert_allclose(
        within_reach(source, relit, np.ones(SHAPE, np.float32), 0.01), relit, atol=1e-6
    )
