"""Light: what is drawn, from nothing to everything.

A photo of 44 x 60 pixels on a grid of about 256 cells. `light on the grid` is the masked mean that the
network sees, compared with float64, relative to its value. `picture` is the result of 2 steps with guidance
2, compared with the same computation in float64.
"""

from __future__ import annotations

import numpy as np
import pytest
import twin

from dior_rt.kernels import Strokes
from dior_rt.relight import NOTHING_DRAWN

SIZE = (44, 60)
SMALLEST = np.finfo(np.float32).tiny  # what is below may be 0 on a device
CODES = {"fp32": 1.0, "fp16": 2.0, "int8": 10.0}


def photo() -> np.ndarray:
    y, x = np.mgrid[0 : 1 : SIZE[0] * 1j, 0 : 1 : SIZE[1] * 1j]
    waves = np.stack([0.5 + 0.45 * np.sin(9 * x + c) * np.cos(7 * y + 2 * c) for c in range(3)], -1)
    return np.round(255 * waves).astype(np.uint8)


def drawn(light, where=np.s_[10:24, 20:44]) -> Strokes:
    """The light (3,) or (H, W, 3) on a part of the photo; it is no number elsewhere."""
    strokes = Strokes(np.full((*SIZE, 3), np.nan, np.float32), np.zeros(SIZE, np.float32))
    strokes.light[where] = np.broadcast_to(light, (*SIZE, 3))[where]
    strokes.mask[where] = 1
    return strokes


def checkered() -> Strokes:
    """Darkness and a hundred times white, cell beside cell and within cells."""
    light = np.zeros((*SIZE, 3), np.float32)
    light[:, ::2] = 100
    return drawn(light)


def faint() -> Strokes:
    strokes = drawn((0.5, 1, 2))
    return Strokes(strokes.light, strokes.mask * np.float32(1e-40))


NORMAL = np.random.default_rng(0).random((*SIZE, 3), np.float32)
BLACK, WHITE = np.zeros((*SIZE, 3), np.uint8), np.full((*SIZE, 3), 255, np.uint8)
CASES = {
    "one pixel": (photo(), drawn((2, 1, 0.5), np.s_[17:18, 31:32])),
    "the whole picture": (photo(), drawn(NORMAL, np.s_[:, :])),
    "1e-6 times normal": (photo(), drawn(1e-6 * NORMAL)),
    "1e4 times normal": (photo(), drawn(1e4 * NORMAL)),
    "pure red": (photo(), drawn((3, 0, 0))),
    "pure green": (photo(), drawn((0, 3, 0))),
    "pure blue": (photo(), drawn((0, 0, 3))),
    "darkness beside 100 times white": (photo(), checkered()),
    "subnormal light": (photo(), drawn((1e-40, 3e-45, 1e-38))),
    "subnormal mask": (photo(), faint()),
    "on black": (BLACK, drawn(NORMAL)),
    "on clipped white": (WHITE, drawn(NORMAL)),
    "darkness on clipped white": (WHITE, drawn((0, 0, 0))),
}


@pytest.fixture(scope="module")
def expected(family, network):
    """The whole way in float64, by case, in codes of 8 bits."""
    return {
        case: 255 * np.clip(twin.relight(family, network, *given, seed=5, steps=2, guidance=2.0), 0, 1)
        for case, given in CASES.items()
    }


@pytest.mark.parametrize("case", CASES)
def test_light_on_the_grid(ops, family, hold, case):
    _, strokes = CASES[case]
    grid = family.raster(*SIZE)
    got = ops.reduce_strokes(strokes.light, strokes.mask, grid)
    light, mask = twin.reduce_strokes(strokes.light, strokes.mask, grid)
    np.testing.assert_array_equal(got.mask, mask)
    assert got.light.min() >= 0
    hold(f"{case}: light on the grid", ops.name.split()[0], got.light, light, 1e-5, "of it", light + SMALLEST)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_picture_on_every_device(relighter, ops, expected, hold, case):
    loaded = relighter("fp32", ops.name.split()[0])
    picture = loaded.relight(*CASES[case], steps=2, guidance=2.0, seed=5).picture
    hold(f"{case}: picture", ops.name.split()[0], picture, expected[case], CODES["fp32"], "1/255")


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("precision", ["fp16", "int8"])
def test_picture_in_every_precision(relighter, expected, hold, precision, case):
    loaded = relighter(precision, "numpy")
    picture = loaded.relight(*CASES[case], steps=2, guidance=2.0, seed=5).picture
    hold(f"{case}: picture", precision, picture, expected[case], CODES[precision], "1/255")


@pytest.mark.parametrize("precision", CODES)
def test_no_light_changes_nothing(relighter, ops, hold, precision):
    loaded = relighter(precision, ops.name.split()[0])
    relit = loaded.relight(photo(), drawn((1, 1, 1), np.s_[:0]), steps=2)
    assert relit.notice == NOTHING_DRAWN
    hold("none: picture", ops.name.split()[0], relit.picture, photo(), 0, "1/255")
