"""The sRGB curve on every device: exact for integers, within 2e-6 of float64 for floats."""

import numpy as np
import pytest
from float64_reference import decode, encode
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.color import rgb2xyz

from dior_rt.kernels import NumpyOps


def codes(dtype):
    return np.arange(np.iinfo(dtype).max + 1).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_accuracy_of_decoding_integers(ops, dtype):
    linear = ops.decode_srgb(codes(dtype))
    error = np.abs(linear - decode(codes(dtype) / np.iinfo(dtype).max)).max()
    print(f"\n{ops.name}: decode {dtype.__name__}, worst error {error:.1e}")
    assert linear.dtype == np.float32
    assert error < 1e-7


def test_decoding_agrees_with_scikit_image(ops):
    """A grey's luminance Y is its linear value, for white has Y = 1."""
    greys = np.repeat(codes(np.uint8)[:, None], 3, 1)
    np.testing.assert_allclose(ops.decode_srgb(greys)[:, 1], rgb2xyz(greys)[:, 1], atol=2e-6)


def test_accuracy_of_floats(ops):
    x = np.linspace(0, 1, 1_000_003).astype(np.float32)
    errors = {
        "decode": np.abs(ops.decode_srgb(x) - decode(x)).max(),
        "encode": np.abs(ops.encode_srgb(x, np.float32) - encode(x)).max(),
    }
    print(f"\n{ops.name}: float32, worst errors {errors}")
    assert max(errors.values()) < 2e-6


def test_floats_beyond_the_range_follow_the_curve(ops):
    x = np.array([-3, -1e-3, -0.0, 1e-42, 1e-7, 1.5, 7, 1e3], np.float32)
    np.testing.assert_allclose(ops.decode_srgb(x), decode(x), rtol=2e-6, atol=1e-9)
    np.testing.assert_allclose(ops.encode_srgb(x, np.float32), encode(x), rtol=2e-6, atol=1e-9)


def test_what_no_float_can_hold_is_infinite(ops):
    assert np.isinf(ops.decode_srgb(np.array([1e20, 3e38], np.float32))).all()


def test_floats_that_are_no_numbers_stay_what_they_are(ops):
    odd = np.array([np.nan, np.inf, -np.inf], np.float32)
    np.testing.assert_array_equal(ops.decode_srgb(odd), odd)
    np.testing.assert_array_equal(ops.encode_srgb(odd, np.float32), odd)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_round_trip_is_the_identity(ops, dtype):
    np.testing.assert_array_equal(ops.encode_srgb(ops.decode_srgb(codes(dtype)), dtype), codes(dtype))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_encoding_to_integers_rounds_exactly(ops, dtype):
    """At random values, and one float above and below each border between two codes."""
    top = np.iinfo(dtype).max
    border = decode((np.arange(top) + 0.5) / top).astype(np.float32)
    x = np.concatenate([
        np.random.default_rng(0).random(100_000, np.float32) ** 3,
        border, np.nextafter(border, np.float32(0)), np.nextafter(border, np.float32(1)),
    ])  # fmt: skip
    exact = encode(x) * top
    rounded = np.floor(exact + 0.5)
    certain = np.abs(exact - np.floor(exact) - 0.5) > 1e-9
    got = ops.encode_srgb(x, dtype)
    assert certain.mean() > 0.99
    np.testing.assert_array_equal(got[certain], rounded[certain])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_encoding_to_integers_clips(ops, dtype):
    x = np.array([-np.inf, -1, 0, 1, 1.0001, 1e30, np.inf, np.nan], np.float32)
    top = np.iinfo(dtype).max
    np.testing.assert_array_equal(ops.encode_srgb(x, dtype), [0, 0, 0, top, top, top, top, 0])


@given(
    x=hnp.arrays(np.float32, st.integers(1, 50), elements=st.floats(-2, 2, width=32)),
    dtype=st.sampled_from([np.uint8, np.uint16]),
)
def test_encoding_keeps_order(x, dtype):
    assert (np.diff(NumpyOps().encode_srgb(np.sort(x), dtype).astype(int)) >= 0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(), (0, 3), (1,), (7, 5, 3)])
def test_shape_and_dtype_are_kept(ops, shape, dtype):
    picture = np.ones(shape, dtype)
    linear = ops.decode_srgb(picture)
    assert (linear.shape, linear.dtype) == (shape, np.float32)
    back = ops.encode_srgb(linear, dtype)
    assert (back.shape, back.dtype) == (shape, dtype)


def test_arrays_need_not_be_contiguous_or_writable(ops):
    picture = np.random.default_rng(0).integers(0, 256, (40, 30, 3), dtype=np.uint8)
    view = picture[::-2, 3::2].transpose(1, 0, 2)
    view.setflags(write=False)
    np.testing.assert_array_equal(ops.decode_srgb(view), ops.decode_srgb(view.copy()))
    np.testing.assert_array_equal(
        ops.encode_srgb(ops.decode_srgb(picture)[:, ::3], np.uint8), picture[:, ::3]
    )


def test_other_dtypes_are_refused(ops):
    with pytest.raises(ValueError, match="float64"):
        ops.decode_srgb(np.zeros(3))
    with pytest.raises(ValueError, match="int32"):
        ops.encode_srgb(np.zeros(3, np.float32), np.int32)
    with pytest.raises(ValueError, match="float64"):
        ops.encode_srgb(np.zeros(3), np.uint8)
