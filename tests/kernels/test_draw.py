"""Brush strokes as rasters: coverage, order, edges, and what lies outside the picture."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.draw import disk

from dior_rt.kernels import NumpyOps, Stroke, numpy_ops, opencl_ops

LINE = Stroke(((10.0, 12.0), (50.0, 30.0), (20.0, 45.0)), 7.0, (1.0, 0.5, 0.25), 2.0)


def coverage(stroke, size):
    """Float64, pixel by pixel: what draw.py's equation says."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    points = np.array(stroke.points if len(stroke.points) > 1 else stroke.points * 2, np.float64)
    nearest = np.full(size, np.inf)
    for a, b in itertools.pairwise(points):
        d = b - a
        along = ((x - a[0]) * d[0] + (y - a[1]) * d[1]) / (d @ d if (d @ d) else 1)
        along = np.clip(along, 0, 1)
        nearest = np.minimum(nearest, np.hypot(x - a[0] - along * d[0], y - a[1] - along * d[1]))
    r = max(stroke.width, 1) / 2
    t = np.clip((r + 0.5 - nearest) / (1 + stroke.softness * r), 0, 1)
    t = (1 - stroke.softness) * t + stroke.softness * t * t * (3 - 2 * t)
    return min(stroke.width, 1) * t


@pytest.mark.parametrize("softness", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (33, 65), (257, 129)])
def test_coverage_is_the_equation(ops, size, softness):
    stroke = Stroke(((-5.0, 3.0), (60.0, 20.0), (30.0, 200.0)), 9.5, softness=softness)
    np.testing.assert_allclose(ops.draw_strokes([stroke], size).mask, coverage(stroke, size), atol=2e-5)


def test_accuracy_of_overlapping_strokes(ops):
    rng = np.random.default_rng(3)
    strokes = [
        Stroke(
            tuple(map(tuple, rng.uniform(-20, 280, (n, 2)))), rng.uniform(0.3, 30), tuple(rng.random(3)), 3.0,
            rng.random(),
        )
        for n in rng.integers(1, 9, 12)
    ]  # fmt: skip
    size = (257, 301)
    light, mask = np.zeros((*size, 3)), np.zeros(size)
    for stroke in strokes:
        c = coverage(stroke, size)
        light = light * (1 - c[..., None]) + c[..., None] * np.array(stroke.color) * stroke.intensity
        mask = mask * (1 - c) + c
    got = ops.draw_strokes(strokes, size)
    error = np.abs(got.mask - mask).max()
    print(f"\n{ops.name}: draw_strokes, worst error of the mask {error:.1e}")
    assert error < 1e-4
    np.testing.assert_allclose(got.light * got.mask[..., None], light, atol=5e-4)


@pytest.mark.parametrize("width", [5.0, 12.0, 40.0])
def test_a_dot_has_the_area_of_its_disc(ops, width):
    mask = ops.draw_strokes([Stroke(((31.3, 29.7),), width)], (64, 64)).mask
    assert mask.sum() == pytest.approx(math.pi * width**2 / 4, rel=0.02)
    rows, columns = disk((29.2, 30.8), width / 2 - 1)
    assert (mask[rows, columns] == 1).all()


@pytest.mark.parametrize("width", [3.0, 8.0])
def test_a_line_has_the_area_of_its_capsule(ops, width):
    mask = ops.draw_strokes([Stroke(((15.0, 20.0), (75.0, 50.0)), width)], (80, 100)).mask
    assert mask.sum() == pytest.approx(width * math.hypot(60, 30) + math.pi * width**2 / 4, rel=0.02)


@given(
    x=st.floats(8, 24),
    y=st.floats(8, 24),
    dx=st.floats(-8, 8),
    dy=st.floats(-8, 8),
    width=st.floats(1e-3, 1.0),
)
@settings(deadline=None)
def test_a_thin_stroke_is_faint_but_there(x, y, dx, dy, width):
    drawn = NumpyOps().draw_strokes([Stroke(((x, y), (x + dx, y + dy)), width, (0.0, 3.0, 0.0))], (32, 32))
    assert 0 < drawn.mask.max() <= width * 1.0001
    np.testing.assert_allclose(drawn.light[drawn.mask > 0][:, 1], 3, rtol=1e-5)


@pytest.mark.parametrize("softness", [0.0, 1.0])
def test_value_never_darkens_at_the_edge(ops, softness):
    drawn = ops.draw_strokes([Stroke(LINE.points, 9, (0.25, 0.5, 1.0), 4.0, softness)], (64, 64))
    edge = (drawn.mask > 0) & (drawn.mask < 1)
    assert edge.sum() > 100
    for channel, value in enumerate((1, 2, 4)):
        np.testing.assert_allclose(drawn.light[drawn.mask > 0][:, channel], value, rtol=1e-4)
    assert (drawn.light[drawn.mask == 0] == 0).all()


def test_the_later_stroke_lies_over_the_earlier(ops):
    red = Stroke(((0.0, 16.0), (64.0, 16.0)), 12.0, (1.0, 0.0, 0.0))
    green = Stroke(((32.0, 0.0), (32.0, 64.0)), 12.0, (0.0, 1.0, 0.0))
    over = ops.draw_strokes([red, green], (32, 64)).light
    under = ops.draw_strokes([green, red], (32, 64)).light
    np.testing.assert_array_equal(over[16, 32], (0, 1, 0))
    np.testing.assert_array_equal(under[16, 32], (1, 0, 0))
    np.testing.assert_array_equal(over[16, 5], (1, 0, 0))


def test_a_stroke_over_itself_is_one_stroke(ops):
    once = ops.draw_strokes([Stroke(((5.0, 16.0), (59.0, 16.0)), 6.0, softness=0.7)], (32, 64))
    twice = ops.draw_strokes([Stroke(((5.0, 16.0), (59.0, 16.0), (5.0, 16.0)), 6.0, softness=0.7)], (32, 64))
    np.testing.assert_allclose(once.mask, twice.mask, atol=1e-6)


def test_softness_falls_from_the_middle_to_the_border(ops):
    soft = ops.draw_strokes([Stroke(((0.5, 32.5),), 40.0, softness=1.0)], (65, 65)).mask[32]
    assert (np.diff(soft[:22]) < 0).all()
    assert soft[0] > 0.99 and soft[10] == pytest.approx(0.5, abs=0.05) and soft[22] == 0


def test_a_window_of_the_picture_shows_the_same_strokes(ops):
    """Points outside the picture count as if it were larger."""
    whole = ops.draw_strokes([LINE], (64, 80))
    moved = Stroke(tuple((x - 15, y - 20) for x, y in LINE.points), LINE.width, LINE.color, LINE.intensity)
    part = ops.draw_strokes([moved], (30, 40))
    np.testing.assert_allclose(part.mask, whole.mask[20:50, 15:55], atol=1e-5)
    np.testing.assert_allclose(part.light, whole.light[20:50, 15:55], atol=1e-5)


@pytest.mark.parametrize("softness", [0.0, 1.0])
@pytest.mark.parametrize(
    ("far", "near"),
    [
        (((-1e9, 10.25), (1e9, 10.25)), ((-100.0, 10.25), (200.0, 10.25))),
        (((20.5, 5.0), (20.5, 1e9)), ((20.5, 5.0), (20.5, 100.0))),
        (((-1e8 + 7, -1e8), (1e8 + 7, 1e8)), ((-93.0, -100.0), (107.0, 100.0))),
        (((30.0, 30.0), (1e9, 1e9), (1e9, -1e9)), ((30.0, 30.0), (130.0, 130.0))),
    ],
)
def test_ends_far_outside_leave_a_line_its_accuracy(ops, far, near, softness):
    """Squares of such distances are none that float32 can hold, or tell apart."""
    drawn = ops.draw_strokes([Stroke(far, 6.0, softness=softness)], (40, 50))
    np.testing.assert_allclose(
        drawn.mask, coverage(Stroke(near, 6.0, softness=softness), (40, 50)), atol=2e-5
    )


def test_a_stroke_as_thin_as_can_be_keeps_its_value(ops):
    drawn = ops.draw_strokes([Stroke(((3.0, 9.0), (40.0, 20.0)), 1e-42, (0.5, 1.0, 2.0))], (32, 48))
    assert 0 < drawn.mask.max() < 1e-18
    np.testing.assert_allclose(drawn.light[drawn.mask > 0].max(0), (0.5, 1, 2), rtol=1e-5)


def test_a_stroke_wider_than_any_picture_is_everywhere(ops):
    drawn = ops.draw_strokes([Stroke(((5.0, 5.0),), 1e9, softness=0.5)], (32, 48))
    np.testing.assert_allclose(drawn.mask, 1, atol=1e-6)


def test_strokes_outside_draw_nothing(ops):
    drawn = ops.draw_strokes([Stroke(((-50.0, -9.0), (900.0, -9.0)), 4.0)], (33, 65))
    assert not drawn.mask.any() and not drawn.light.any()


def test_no_strokes_draw_nothing(ops):
    drawn = ops.draw_strokes([], (5, 7))
    assert drawn.light.shape == (5, 7, 3) and drawn.mask.shape == (5, 7) and not drawn.mask.any()


def test_a_black_stroke_says_dark(ops):
    drawn = ops.draw_strokes([Stroke(((8.0, 8.0),), 6.0, intensity=0.0)], (16, 16))
    assert drawn.mask[8, 8] == 1 and not drawn.light.any()


def test_bands_leave_no_seam(ops, monkeypatch):
    whole = ops.draw_strokes([LINE], (64, 80))
    monkeypatch.setattr(numpy_ops, "BAND", 300)
    monkeypatch.setattr(opencl_ops, "BAND", 300)
    banded = ops.draw_strokes([LINE], (64, 80))
    np.testing.assert_allclose(banded.mask, whole.mask, atol=1e-6)
    np.testing.assert_allclose(banded.light, whole.light, atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"points": ()},
        {"points": ((1.0, math.nan),)},
        {"points": ((1.0, 2e9),)},
        {"points": ((1.0,),)},
        {"width": 0.0},
        {"width": math.inf},
        {"width": 2e9},
        {"color": (1.0, 1.0)},
        {"color": (1.0, -1.0, 1.0)},
        {"intensity": -1.0},
        {"intensity": math.nan},
        {"softness": 1.5},
    ],
)
def test_strokes_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="stroke"):
        Stroke(**({"points": ((1.0, 1.0),), "width": 2.0} | wrong))
