"""Photos and strokes on the light grid: exact area means, and masked means that see only what is drawn."""

import numpy as np
import pytest
from skimage.transform import downscale_local_mean

from dior_rt.kernels import numpy_ops, opencl_ops

SIZES = [(1, 1), (1, 7), (7, 1), (33, 65), (257, 129)]
GRIDS = [(1, 1), (4, 4), (5, 3), (16, 40), (64, 64)]


def _at(line, places):
    """The values of a line of samples at places between them."""
    return np.interp(places, np.arange(len(line)), line)


def area_mean(picture, grid):
    """Float64: the difference of the integral image, linear between pixels, at the cells' borders."""
    for axis, cells in enumerate(grid):
        pixels = picture.shape[axis]
        sums = np.cumsum(picture, axis, dtype=np.float64)
        sums = np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis)
        at = np.arange(cells + 1) * pixels / cells
        integral = np.apply_along_axis(_at, axis, sums, at)
        picture = np.diff(integral, axis=axis) * (cells / pixels)
    return picture


def random_picture(size, dtype, seed=0):
    picture = np.random.default_rng(seed).random((*size, 3), np.float32)
    return picture if dtype == np.float32 else (picture * np.iinfo(dtype).max).astype(dtype)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("size", SIZES)
def test_a_photo_becomes_its_area_means(ops, size, grid):
    photo = random_picture(size, np.uint8)
    np.testing.assert_allclose(
        ops.reduce_photo(photo, grid), area_mean(ops.decode_srgb(photo), grid), atol=2e-6
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_accuracy_of_reduce_photo(ops, dtype):
    photo = random_picture((757, 1003), dtype)
    got = ops.reduce_photo(photo, (56, 76))
    error = np.abs(got - area_mean(ops.decode_srgb(photo), (56, 76))).max()
    print(f"\n{ops.name}: reduce_photo of {dtype.__name__}, worst error {error:.1e}")
    assert got.dtype == np.float32
    assert error < 2e-6


def test_whole_ratios_agree_with_scikit_image(ops):
    photo = random_picture((64, 96), np.uint8)
    expected = downscale_local_mean(ops.decode_srgb(photo).astype(np.float64), (4, 8, 1))
    np.testing.assert_allclose(ops.reduce_photo(photo, (16, 12)), expected, atol=1e-6)


def test_the_grid_of_a_photo_at_its_own_size_is_the_photo(ops):
    photo = random_picture((33, 65), np.uint16)
    np.testing.assert_array_equal(ops.reduce_photo(photo, (33, 65)), ops.decode_srgb(photo))


def test_bands_leave_no_seam(ops, monkeypatch):
    photo = random_picture((257, 129), np.uint8)
    mask = (random_picture((257, 129), np.float32)[..., 0] < 0.1).astype(np.float32)
    whole, strokes = ops.reduce_photo(photo, (13, 7)), ops.reduce_strokes(photo, mask, (13, 7))
    monkeypatch.setattr(numpy_ops, "BAND", 1000)
    monkeypatch.setattr(opencl_ops, "BAND", 1000)
    np.testing.assert_allclose(ops.reduce_photo(photo, (13, 7)), whole, atol=1e-6)
    banded = ops.reduce_strokes(photo, mask, (13, 7))
    np.testing.assert_allclose(banded.light, strokes.light, atol=1e-6)
    np.testing.assert_array_equal(banded.mask, strokes.mask)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("size", SIZES)
def test_strokes_become_masked_means(ops, size, grid):
    rng = np.random.default_rng(1)
    light = rng.random((*size, 3), np.float32) * 4
    mask = np.where(rng.random(size) < 0.2, rng.random(size), 0).astype(np.float32)
    weight = area_mean(mask[..., None], grid)
    total = area_mean(light * mask[..., None].astype(np.float64), grid)
    got = ops.reduce_strokes(light, mask, grid)
    specified = got.mask > 0
    # The reference's own rounding leaves some 1e-16 where there is nothing.
    np.testing.assert_array_equal(got.mask, weight[..., 0] > 1e-12)
    np.testing.assert_allclose(
        got.light[specified], (total / np.maximum(weight, 1e-300))[specified], rtol=1e-5
    )
    assert (got.light[~specified] == 0).all()
    assert got.light.dtype == got.mask.dtype == np.float32


def test_a_stroke_of_one_pixel_keeps_its_value_on_a_large_photo(ops):
    light, mask = np.zeros((2003, 3001, 3), np.float32), np.zeros((2003, 3001), np.float32)
    light[1234, 2345], mask[1234, 2345] = (5.0, 0.25, 0.125), 1 / 255
    got = ops.reduce_strokes(light, mask, (52, 80))
    assert got.mask.sum() == 1
    np.testing.assert_allclose(got.light[got.mask > 0], [(5.0, 0.25, 0.125)], rtol=1e-6)


def test_what_is_unspecified_is_never_looked_at(ops):
    light = np.full((33, 65, 3), np.nan, np.float32)
    mask = np.zeros((33, 65), np.float32)
    light[4:9, 30:50], mask[4:9, 30:50] = 0.5, 1
    got = ops.reduce_strokes(light, mask, (5, 8))
    np.testing.assert_array_equal(got.light[got.mask > 0], 0.5)
    assert 0 < got.mask.sum() < 40


def test_a_dark_stroke_is_specified(ops):
    got = ops.reduce_strokes(np.zeros((9, 9, 3), np.float32), np.ones((9, 9), np.float32), (3, 3))
    assert (got.mask == 1).all() and (got.light == 0).all()


@pytest.mark.parametrize("mask_dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_integers_are_encoded_and_floats_linear(ops, dtype, mask_dtype):
    light, mask = random_picture((33, 65), dtype), random_picture((33, 65), mask_dtype, 1)[..., 0]
    linear = light if dtype == np.float32 else ops.decode_srgb(light)
    weights = mask if mask_dtype == np.float32 else (mask / np.iinfo(mask_dtype).max).astype(np.float32)
    got, expected = ops.reduce_strokes(light, mask, (6, 9)), ops.reduce_strokes(linear, weights, (6, 9))
    np.testing.assert_allclose(got.light, expected.light, rtol=1e-5)
    np.testing.assert_array_equal(got.mask, expected.mask)


def test_strokes_that_are_everywhere_are_a_photo(ops):
    photo = random_picture((33, 65), np.uint8)
    got = ops.reduce_strokes(photo, np.full((33, 65), 255, np.uint8), (7, 9))
    np.testing.assert_allclose(got.light, ops.reduce_photo(photo, (7, 9)), atol=1e-6)


def test_views_are_reduced_like_copies(ops):
    photo = random_picture((80, 90), np.uint8)[::-2, 5::3]
    np.testing.assert_array_equal(ops.reduce_photo(photo, (4, 4)), ops.reduce_photo(photo.copy(), (4, 4)))


@pytest.mark.parametrize(
    ("light", "mask", "grid"),
    [
        ((4, 4, 4), (4, 4), (2, 2)),
        ((4, 4), (4, 4), (2, 2)),
        ((0, 4, 3), (0, 4), (2, 2)),
        ((4, 4, 3), (4, 5), (2, 2)),
        ((4, 4, 3), (4, 4, 1), (2, 2)),
        ((4, 4, 3), (4, 4), (0, 2)),
    ],
)
def test_wrong_shapes_are_refused(ops, light, mask, grid):
    with pytest.raises(ValueError, match=r"must|needs"):
        ops.reduce_strokes(np.zeros(light, np.uint8), np.zeros(mask, np.uint8), grid)


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
def test_a_mask_out_of_range_is_refused(ops, value):
    with pytest.raises(ValueError, match=r"0\.\.1"):
        ops.reduce_strokes(np.zeros((2, 2, 3), np.uint8), np.full((2, 2), value, np.float32), (1, 1))
