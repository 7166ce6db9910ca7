"""The model that ships: complete, within its bounds, and it answers to the brush."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt import Relighter
from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.kernels import NumpyOps, Strokes

EXAMPLES = Path(__file__).parents[2] / "examples"
OPS = NumpyOps()


@pytest.fixture(scope="module")
def relighter():
    return Relighter(device="cpu")


@pytest.fixture(scope="module", params=["coffee.jpg", "chelsea.jpg", "astronaut.jpg"])
def photo(request):
    return np.asarray(Image.open(EXAMPLES / request.param).convert("RGB"))


@pytest.fixture(scope="module")
def brushed(photo):
    """A disc in the middle, a fifth of the photo wide."""
    height, width = photo.shape[:2]
    y, x = np.mgrid[:height, :width]
    return np.hypot(y - height / 2, x - width / 2) < min(height, width) / 10


def under_the_brush(relighter, photo, brushed, light):
    """Mean linear RGB under the brush, after light of this colour was drawn there."""
    strokes = Strokes(np.broadcast_to(np.float32(light), photo.shape), brushed.astype(np.float32))
    return OPS.decode_srgb(relighter.relight(photo, strokes, seed=1).picture)[brushed].mean(0)


def test_it_is_whole_small_and_measured():
    bundle = read_bundle(default_bundle())
    size = sum(path.stat().st_size for path in bundle.folder.iterdir())
    assert size <= 32e6
    assert bundle.manifest.family == "mini" and bundle.manifest.licence == "Apache-2.0"
    assert bundle.manifest.parity["evaluation"] <= 1e-4
    assert bundle.manifest.parity["sampling_db"] >= 60


def test_dark_strokes_darken_and_bright_ones_are_far_brighter(relighter, photo, brushed):
    before = OPS.decode_srgb(photo)[brushed].mean()
    dark, bright = (under_the_brush(relighter, photo, brushed, [light] * 3).mean() for light in (0.0, 3.0))
    assert dark < 0.8 * before and bright > 1.5 * dark


def test_bright_strokes_brighten(relighter, photo, brushed):
    before = OPS.decode_srgb(photo)[brushed].mean()
    assert under_the_brush(relighter, photo, brushed, [3.0] * 3).mean() > before


def test_red_strokes_redden_and_blue_ones_turn_blue(relighter, photo, brushed):
    red = under_the_brush(relighter, photo, brushed, [2.0, 0.4, 0.4])
    blue = under_the_brush(relighter, photo, brushed, [0.4, 0.4, 2.0])
    assert red[0] / red[2] > 1.5 * blue[0] / blue[2]


def test_a_tolerance_holds_against_the_reference_and_takes_fewer_steps(relighter, photo, brushed):
    strokes = Strokes(np.full(photo.shape, 1.5, np.float32), brushed.astype(np.float32))
    reference = relighter.relight(photo, strokes)
    within = relighter.relight(photo, strokes, tolerance=0.5 / 255)
    error = (within.picture.astype(np.float64) - reference.picture) / 255
    assert within.steps < reference.steps / 2 and np.sqrt(np.mean(error**2)) < 0.5 / 255


WALLS = pytest.mark.parametrize("wall", [(0.6, 0.6, 0.6), (0.15, 0.2, 0.3)])
LIGHTS = pytest.mark.parametrize("light", [(1.5, 0.9, 0.4), (0.02, 0.02, 0.02)])


def dab_on_a_wall(relighter, wall, light, column):
    """An even wall, 224 x 320, with one dab: the logarithm of its change of light, and how far the dab is."""
    y, x = np.mgrid[:224, :320]
    shade = 0.8 + 0.3 * x / 320 + 0.1 * y / 224
    photo = np.round(255 * shade[..., None] * wall).astype(np.uint8)
    away = np.hypot(y - 112, x - column)
    strokes = Strokes(np.broadcast_to(np.float32(light), photo.shape), (away < 20).astype(np.float32))
    relit = OPS.decode_srgb(relighter.relight(photo, strokes).picture)
    return np.log((relit + 0.02) / (OPS.decode_srgb(photo) + 0.02)).mean(axis=2), away


@WALLS
@LIGHTS
def test_a_dab_on_an_even_wall_leaves_no_ring(relighter, wall, light):
    """Rings come of following what is drawn less under a dab than just beside it."""
    ratio, away = dab_on_a_wall(relighter, wall, light, 160)
    rings = [np.abs(ratio)[(away >= 4 * k) & (away < 4 * k + 4)].mean() for k in range(25)]
    assert max(rings[4:]) < max(rings[:4]) + 0.15 and rings[-1] < 0.8 * max(rings[:4])


@WALLS
@LIGHTS
def test_an_even_wall_shows_no_cells(relighter, wall, light):
    """What the network's cells differ by where the photo does not: the weave of its finer convolutions."""
    ratio, _ = dab_on_a_wall(relighter, wall, light, 60)
    cells = ratio.reshape(56, 4, 80, 4).mean(axis=(1, 3))[:, 30:]
    for axis in (0, 1):
        assert np.diff(cells, 2, axis=axis).std() < 0.01
