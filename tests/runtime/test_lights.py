"""Lights as layers: the equations of the blend modes, and what a photo makes of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.primaries import DISPLAY_P3, SRGB_TAG, conversion, make_profile, srgb, to_xyz
from dior_rt.images.strokes import read_drawing, read_strokes
from dior_rt.kernels import NumpyOps, Stroke, Strokes
from dior_rt.kernels.types import STRONGEST
from dior_rt.lights import LEAST_COVERAGE, Light, compose, convert_lights, cover
from dior_rt.project import LightRecord, PhotoRef, Project, ShapeRecord, lights_of, write_project
from dior_rt.relight import NOTHING_DRAWN, Relighter

GRID = (4, 6)


def drawn(value=(2.0, 1.0, 0.5), coverage=1.0, size=(8, 12), rows=slice(0, 4)):
    """A layer over the upper half."""
    mask = np.zeros(size, np.float32)
    mask[rows] = coverage
    return Strokes(np.broadcast_to(np.float32(value), (*size, 3)) * (mask > 0)[..., None], mask)


def source(value=0.5):
    return np.full((*GRID, 3), value, np.float32)


def composed(*lights, on=None):
    below = source() if on is None else on
    return compose(below, lights, [cover(light.drawn, GRID) for light in lights])


@pytest.mark.parametrize(
    ("blend", "expected"), [("set", (2, 1, 0.5)), ("add", (2.5, 1.5, 1.0)), ("multiply", (1.0, 0.5, 0.25))]
)
def test_a_full_layer_follows_its_equation(blend, expected):
    target = composed(Light(drawn(), blend)).target
    assert np.allclose(target.light[:2], expected)
    assert np.array_equal(target.mask, np.repeat([1.0, 0.0], 2)[:, None] * np.ones((1, 6)))


@pytest.mark.parametrize("blend", ["set", "add", "multiply"])
def test_half_coverage_goes_half_the_way(blend):
    full = composed(Light(drawn(), blend)).target.light[0, 0]
    half = composed(Light(drawn(coverage=0.5), blend)).target.light[0, 0]
    assert np.allclose(half, (source()[0, 0] + full) / 2)


@pytest.mark.parametrize("blend", ["set", "add", "multiply"])
@settings(deadline=None)
@given(strength=st.floats(0, 16), coverage=st.floats(LEAST_COVERAGE + 1e-3, 1))
def test_every_blend_is_linear_in_the_strength(blend, strength, coverage):
    def light(s):
        return composed(Light(drawn(coverage=coverage), blend, strength=s)).target.light[0, 0]

    assert np.allclose(light(strength) - light(0), strength * (light(1) - light(0)), rtol=1e-4, atol=1e-5)


@settings(deadline=None)
@given(value=st.lists(st.floats(0, 16), min_size=3, max_size=3), coverage=st.floats(0, 1))
def test_adding_a_lamp_never_darkens(value, coverage):
    assert (composed(Light(drawn(value, coverage), "add")).target.light >= source()).all()


def test_layers_act_in_order_on_what_lies_below():
    add, half = Light(drawn((1, 1, 1)), "add"), Light(drawn((0.5, 0.5, 0.5)), "multiply")
    assert np.allclose(composed(add, half).target.light[0, 0], 0.75)
    assert np.allclose(composed(half, add).target.light[0, 0], 1.25)
    assert np.allclose(composed(add, Light(drawn((3, 3, 3)), "set")).target.light[0, 0], 3)


def test_a_tint_colours_the_drawn_light_and_a_muted_layer_counts_for_nothing():
    assert np.allclose(
        composed(Light(drawn((1, 1, 1)), "set", tint=(1, 0.5, 0))).target.light[0, 0], [1, 0.5, 0]
    )
    assert not composed(Light(drawn(), "set", on=False)).target.mask.any()


def test_a_cell_that_is_barely_touched_is_left_to_the_model():
    mask = np.zeros((8, 12), np.float32)
    mask[0, 0], mask[4:, 6:] = 0.2, 1  # 0.05 of the first cell
    strokes = Strokes(np.ones((8, 12, 3), np.float32), mask)
    target = composed(Light(strokes, "add")).target
    assert target.mask[0, 0] == 0 and target.mask[3, 5] == 1


def test_reach_is_each_layers_own_and_the_farthest_counts():
    near, far = Light(drawn(rows=slice(0, 2)), "add", reach=0.05), Light(drawn(rows=slice(6, 8)), "add")
    assert composed(near).nearness[-1].max() < 1e-3 < 0.999 < composed(near).nearness[0].min()
    assert composed(near, far).nearness is None


def test_light_where_nothing_is_drawn_is_never_read():
    strokes = drawn()
    strokes.light[strokes.mask == 0] = np.nan
    assert np.isfinite(composed(Light(strokes, "add")).target.light).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"blend": "screen"},
        {"strength": -1},
        {"strength": float("nan")},
        {"tint": (1, 1)},
        {"tint": (1, 1, -1)},
        {"reach": 0},
    ],
)
def test_a_light_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError):
        Light(drawn(), **wrong)


def test_light_too_strong_for_float32_is_refused():
    with pytest.raises(InputError, match="too strong"):
        composed(Light(drawn((3e38, 1, 1)), "set", strength=10))


def test_light_is_bounded_as_it_is_for_strokes():
    assert composed(Light(drawn((STRONGEST / 2, 1, 1)), "set")).target.light.max() == STRONGEST / 2
    with pytest.raises(InputError, match="too strong"):
        composed(Light(drawn((STRONGEST / 2, 1, 1)), "set", strength=3))


# On a photo, with the weights that ship


@pytest.fixture(scope="module")
def relighter(mini_bundle):
    return Relighter(mini_bundle, device="cpu", ops="numpy")


@pytest.fixture(scope="module")
def photo():
    rng = np.random.default_rng(3)
    coarse = Image.fromarray(rng.integers(40, 200, (6, 9, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((90, 60), Image.Resampling.BICUBIC))


def lamp(blend="add", value=(2.0, 1.5, 1.0), **fields):
    return Light(drawn(value, size=(60, 90), rows=slice(10, 25)), blend, **fields)


def test_an_open_photo_gives_what_relight_gives(relighter, photo):
    strokes = lamp().drawn
    opened = relighter.open(photo)
    for drawing in (strokes, [lamp()]):
        once = relighter.relight(photo, drawing, seed=5).picture
        assert np.array_equal(opened.relight(drawing, seed=5).picture, once)
        assert np.array_equal(
            opened.relight(drawing, seed=5).picture, once
        )  # and once more, from what is kept


def test_the_target_is_the_source_map_and_the_lamp(relighter, photo):
    opened = relighter.open(photo)
    target, below = opened.target_map([lamp()]), opened.source_map()
    inside = target.mask > 0
    assert (target.light[inside] >= below[inside]).all()
    full = np.isclose(target.light - below, [2.0, 1.5, 1.0], atol=1e-4).all(axis=-1)
    assert full.any() and inside[full].all()


def test_adding_brightens_and_multiplying_darkens_where_it_was_drawn(relighter, photo):
    opened = relighter.open(photo)
    brighter = opened.preview([lamp()]).picture[10:25].astype(int)
    darker = opened.preview([lamp("multiply", (0.1, 0.1, 0.1))]).picture[10:25].astype(int)
    assert brighter.mean() > photo[10:25].mean() + 5
    assert darker.mean() < photo[10:25].mean() - 5


def test_a_short_reach_keeps_the_rest_of_the_photo(relighter, photo):
    preview = relighter.open(photo).preview([lamp(reach=0.03)]).picture
    assert np.abs(preview[-20:].astype(int) - photo[-20:]).max() <= 2


def test_a_preview_is_small_and_8_bit(relighter, photo):
    for pixels in (photo, photo.astype(np.uint16) * 257, photo.astype(np.float32) / 255):
        picture = relighter.open(pixels).preview([lamp()], longest=45).picture
        assert (picture.shape, picture.dtype) == ((30, 45, 3), np.uint8)


def test_lights_that_are_all_off_leave_the_photo_unchanged(relighter, photo):
    relit = relighter.relight(photo, [lamp(on=False)])
    assert relit.notice == NOTHING_DRAWN and np.array_equal(relit.picture, photo)


def test_strokes_and_lights_in_one_list_are_refused(relighter, photo):
    with pytest.raises(InputError, match="not both"):
        relighter.relight(photo, [lamp(), Stroke(((1, 1),), 3)])


# Photos with other primaries

P3 = to_xyz(DISPLAY_P3)
TO_P3 = conversion(srgb(), P3)


@pytest.mark.parametrize("blend", ["set", "add", "multiply"])
def test_lights_are_drawn_in_the_primaries_of_the_photo(relighter, photo, blend):
    """In sRGB's primaries, whether the image names its own, the caller does, or the lights come converted."""
    lights = [lamp(blend, (2.0, 0.5, 0.1), tint=(0.5, 1.0, 0.25))]
    image = Image.fromarray(photo)
    image.info["icc_profile"] = make_profile(DISPLAY_P3, SRGB_TAG)
    named = relighter.open(image).target_map(lights)
    asked = relighter.open(photo, P3).target_map(lights)
    converted = relighter.open(photo).target_map(convert_lights(lights, TO_P3))
    plain = relighter.open(photo).target_map(lights)
    np.testing.assert_allclose(named.light, asked.light, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(asked.light, converted.light, rtol=1e-4, atol=1e-5)
    assert np.abs(asked.light - plain.light).max() > 0.01
    if blend == "set":
        inside = drawn(size=(60, 90), rows=slice(10, 25))
        full = cover(inside, asked.mask.shape).coverage > 0.999
        np.testing.assert_allclose(
            asked.light[full], TO_P3 @ (1.0, 0.5, 0.025) + 0 * asked.light[full], rtol=1e-3
        )


def test_white_light_is_white_in_all_primaries(relighter, photo):
    lights = [lamp("add", (2.0, 2.0, 2.0)), lamp("multiply", (0.5, 0.5, 0.5))]
    asked, plain = relighter.open(photo, P3).target_map(lights), relighter.open(photo).target_map(lights)
    np.testing.assert_allclose(asked.light, plain.light, atol=5e-3)


def test_a_project_is_read_in_the_primaries_of_the_photo(tmp_path, relighter, photo):
    """The command line reads the drawing for a photo; the desk opens the photo. Both give the same."""
    shape = ShapeRecord("stroke", ((20.0, 20.0), (60.0, 40.0)), color=(1.0, 0.2, 0.0), intensity=3, width=20)
    layers = (LightRecord("Lamp", "add", tint=(1.0, 0.5, 0.5), shapes=(shape,)), LightRecord("None", "set"))
    project = Project(PhotoRef((90, 60)), layers)
    write_project(tmp_path / "a.dior", project)
    drawing = read_drawing(tmp_path / "a.dior", (60, 90), primaries=P3).strokes
    command = relighter.relight(photo, drawing, steps=2).picture
    desk = relighter.open(photo, P3).relight(lights_of(project, (60, 90)), steps=2).picture
    assert np.abs(command.astype(int) - desk).max() <= 1
    other = relighter.open(photo).relight(lights_of(project, (60, 90)), steps=2).picture
    assert np.abs(command.astype(int) - other).max() > 1


def test_json_strokes_that_blend_are_converted(tmp_path):
    path = tmp_path / "strokes.json"
    path.write_text('[{"points": [[1, 1]], "width": 3, "blend": "add", "color": [1, 0.5, 0]}]')
    (layer,) = read_drawing(path, (60, 90), primaries=P3).strokes
    np.testing.assert_allclose(layer.drawn[0].color, TO_P3 @ (1, 0.5, 0), rtol=1e-6)


def test_strokes_converted_as_lights_are_converted_as_strokes():
    (light,) = convert_lights([Light((Stroke(((1, 1),), 3, (1.0, 0.5, 0.25)),), tint=(1.0, 0.5, 1.0))], TO_P3)
    np.testing.assert_allclose(light.drawn[0].color, TO_P3 @ (1.0, 0.25, 0.25))
    assert light.tint == (1.0, 1.0, 1.0)


def test_json_strokes_that_blend_become_layers(tmp_path, relighter, photo):
    path = tmp_path / "strokes.json"
    path.write_text(
        """[{"points": [[10, 10], [40, 30]], "width": 12, "blend": "add", "intensity": 2},
            {"points": [[20, 40]], "width": 9, "blend": "add"},
            {"points": [[70, 40]], "width": 20, "blend": "multiply", "color": [0.2, 0.2, 0.2]},
            {"points": [[50, 50]], "width": 9}]"""
    )
    layers = read_strokes(path, (60, 90))
    assert [(layer.blend, len(layer.drawn)) for layer in layers] == [("add", 2), ("multiply", 1), ("set", 1)]
    relit = relighter.relight(photo, layers)
    raster = [Light(NumpyOps().draw_strokes(list(layer.drawn), (60, 90)), layer.blend) for layer in layers]
    assert np.array_equal(relit.picture, relighter.relight(photo, raster).picture)


def test_json_strokes_that_only_set_stay_strokes(tmp_path):
    path = tmp_path / "strokes.json"
    path.write_text('[{"points": [[1, 1]], "width": 3, "blend": "set"}, {"points": [[5, 5]], "width": 3}]')
    assert read_strokes(path, (60, 90)) == [Stroke(((1, 1),), 3), Stroke(((5, 5),), 3)]


def test_a_blend_that_is_unknown_is_refused(tmp_path):
    path = tmp_path / "strokes.json"
    path.write_text('[{"points": [[1, 1]], "width": 3, "blend": "screen"}]')
    with pytest.raises(InputError, match="stroke 1: blend must be one of set, add, multiply, not 'screen'"):
        read_strokes(path, (60, 90))
