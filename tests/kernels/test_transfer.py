"""Quotient light on the full-size photo: what must come out exactly, and what must not be seen."""

import tracemalloc

import numpy as np
import pytest
from float64_reference import E, decode, encode, transfer
from skimage import data

from dior_rt.kernels import NumpyOps, numpy_ops, opencl_ops

SIZES = [(1, 1), (1, 7), (7, 1), (33, 65), (257, 129)]
TOP = {np.uint8: 255, np.uint16: 65535, np.float32: 1}


def random_photo(size, dtype, seed=0):
    photo = np.random.default_rng(seed).random((*size, 3), np.float32)
    return photo if dtype == np.float32 else (photo * TOP[dtype] + 0.5).astype(dtype)


def random_grids(grid, seed=1):
    return np.random.default_rng(seed).random((2, *grid, 3), np.float32) ** 2


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("size", SIZES)
def test_equal_grids_return_the_photo(ops, size, dtype):
    photo, (source, _) = random_photo(size, dtype), random_grids((9, 12))
    got = ops.transfer(photo, source, source)
    assert got.dtype == dtype and not np.shares_memory(got, photo)
    np.testing.assert_allclose(got, photo, atol=1e-6 if dtype == np.float32 else 0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_equal_grids_return_every_code(ops, dtype):
    codes = np.arange(TOP[dtype] + 1).astype(dtype).reshape(16, -1, 1).repeat(3, 2)
    source = ops.reduce_photo(codes, (8, 8))
    np.testing.assert_array_equal(ops.transfer(codes, source, source), codes)


@pytest.mark.parametrize(("dtype", "most"), [(np.uint8, 0.51), (np.uint16, 2.0), (np.float32, 1e-5)])
@pytest.mark.parametrize("size", [*SIZES, (301, 403)])
def test_accuracy_of_transfer(ops, size, dtype, most):
    """Against float64 before rounding: half a code, and for 16 bits what float32 leaves of R."""
    photo, (source, relit) = random_photo(size, dtype), random_grids((9, 12))
    expected = transfer(photo, source, relit)
    if dtype != np.float32:
        expected = np.clip(expected, 0, 1) * TOP[dtype]
    error = np.abs(ops.transfer(photo, source, relit) - expected).max()
    print(f"\n{ops.name}: transfer of {dtype.__name__} {size}, worst error {error:.2g}")
    assert error < most


@pytest.mark.parametrize("columns", [1, 3, 6, 7, 13, 30, 120, 403, 500])
def test_cells_of_any_width_are_relit_alike(ops, columns):
    """Cells of 400 to less than one pixel: wide ones go by registers of their own, narrow ones share them."""
    photo, (source, relit) = random_photo((41, 403), np.uint8), random_grids((5, columns))
    expected = np.clip(transfer(photo, source, relit), 0, 1) * 255
    assert np.abs(ops.transfer(photo, source, relit) - expected).max() < 0.51


@pytest.mark.parametrize("grid", [(1, 1), (1, 9), (64, 64), (3, 300)])
@pytest.mark.parametrize("size", SIZES)
def test_any_grid_fits_any_photo(ops, size, grid):
    photo, (source, relit) = random_photo(size, np.uint8), random_grids(grid)
    expected = np.clip(transfer(photo, source, relit), 0, 1) * 255
    assert np.abs(ops.transfer(photo, source, relit) - expected).max() < 0.51


@pytest.mark.parametrize("k", [0.25, 0.7, 1.3])
def test_a_constant_quotient_scales_the_light(ops, k):
    """Exactly (photo + e) * k - e where relit + e = k * (source + e)."""
    photo = (random_photo((65, 90), np.float32) * 0.5 + 0.3).astype(np.float32)
    source = ops.reduce_photo(photo, (8, 12))
    relit = np.float32(k) * (source + np.float32(E)) - np.float32(E)
    got = ops.decode_srgb(ops.transfer(photo, source, relit))
    np.testing.assert_allclose(got, (ops.decode_srgb(photo) + E) * k - E, atol=3e-6)


def test_brighter_light_on_the_grid_is_that_much_brighter_on_the_photo(ops):
    """relit = k * source gives k times the photo's linear light, up to what e takes."""
    photo = (
        ops.encode_srgb(np.full((64, 64, 3), 0.2, np.float32), np.uint16) + random_photo((64, 64), np.uint8)
    ).astype(np.uint16)
    source = ops.reduce_photo(photo, (8, 8))
    got = ops.decode_srgb(ops.transfer(photo, source, source * np.float32(2)))
    np.testing.assert_allclose(got, 2 * ops.decode_srgb(photo), atol=2e-3)


def test_black_and_clipped_parts_take_light_too(ops):
    """A ratio alone leaves black black: the additive part (R - 1) * e is what arrives."""
    black = np.zeros((32, 32, 3), np.uint8)
    source, relit = np.zeros((4, 4, 3), np.float32), np.full((4, 4, 3), 0.5, np.float32)
    np.testing.assert_allclose(
        ops.transfer(black, source, relit), np.round(255 * encode(np.float64(0.5))), atol=1
    )
    white = np.full((32, 32, 3), 255, np.uint8)
    np.testing.assert_allclose(
        ops.transfer(white, source + 1, relit), np.round(255 * encode(np.float64(0.5))), atol=1
    )


def two_regions(edge):
    """A dark and a bright flat, parted at column `edge`, under light 1.6 and 0.4: (photo, relit photo)."""
    photo = np.full((128, 512, 3), 60, np.uint8)
    photo[:, edge:] = 200
    light = np.where(np.arange(512) < edge, 1.6, 0.4)[:, None]
    linear = (decode(photo / 255) + E) * light - E
    return photo, np.round(255 * encode(linear)).astype(np.uint8)


@pytest.mark.parametrize("edge", range(250, 266))
def test_light_does_not_leak_across_a_strong_edge(ops, edge):
    """The edge goes through a cell of 8 pixels in every way. Bilinear interpolation is off by 41 here."""
    photo, target = two_regions(edge)
    source, relit = (ops.reduce_photo(picture, (16, 64)) for picture in (photo, target))
    error = np.abs(ops.transfer(photo, source, relit).astype(int) - target)
    assert error.max() <= 18
    assert error.mean() < 0.1


@pytest.mark.parametrize("edge", [251, 256])
def test_there_is_no_halo(ops, edge):
    """Nothing is brighter or darker than both sides of the edge are under their own light."""
    photo, target = two_regions(edge)
    source, relit = (ops.reduce_photo(picture, (16, 64)) for picture in (photo, target))
    got = ops.transfer(photo, source, relit).astype(int)
    for side in (slice(0, edge), slice(edge, 512)):
        brightest, darkest = photo[0, side, 0].max(), target[0, side, 0]
        low, high = sorted((int(brightest), int(darkest[0])))
        assert got[:, side].min() >= low - 11 and got[:, side].max() <= high + 11


def test_smooth_light_shows_no_cells(ops):
    """Smooth light on a flat grey: the slope of log R changes no faster than the light's, to a tenth."""
    height, width, grid = 16, 1024, (1, 64)
    photo = np.full((height, width, 3), 0.5, np.float32)
    u = (np.arange(64) + 0.5) / 64
    log_r = np.sin(2 * np.pi * u)
    source = ops.reduce_photo(photo, grid)
    relit = (np.exp2(log_r)[None, :, None] * (source + E) - E).astype(np.float32)
    got = np.log2(
        (decode(ops.transfer(photo, source, relit)[8, :, 0].astype(np.float64)) + E) / (source[0, 0, 0] + E)
    )
    x = (np.arange(width) + 0.5) / width
    inner = slice(32, -32)
    np.testing.assert_allclose(got[inner], np.sin(2 * np.pi * x)[inner], atol=2e-3)
    slope = np.gradient(got, x)
    np.testing.assert_allclose(slope[inner], (2 * np.pi * np.cos(2 * np.pi * x))[inner], atol=0.1 * 2 * np.pi)


def test_detail_comes_from_the_photo(ops):
    """A real picture under a smooth light: far better than its relit grid alone."""
    photo = data.astronaut()
    y, x = np.mgrid[:512, :512] / 512
    light = (0.3 + 1.2 * np.exp(-((x - 0.6) ** 2 + (y - 0.3) ** 2) / 0.05))[..., None]
    target = ops.encode_srgb((ops.decode_srgb(photo) * light).astype(np.float32), np.uint8)
    source, relit = (ops.reduce_photo(picture, (64, 64)) for picture in (photo, target))
    got = ops.transfer(photo, source, relit)
    blocks = ops.encode_srgb(relit, np.uint8).repeat(8, 0).repeat(8, 1)

    def psnr(picture):
        return 10 * np.log10(255**2 / np.mean((picture.astype(float) - target) ** 2))

    assert psnr(got) > 36
    assert psnr(got) > psnr(blocks) + 12


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_bands_leave_no_seam(ops, dtype, monkeypatch):
    photo, (source, relit) = random_photo((129, 65), dtype), random_grids((9, 12))
    whole = ops.transfer(photo, source, relit)
    monkeypatch.setattr(numpy_ops, "BAND", 500)
    monkeypatch.setattr(opencl_ops, "BAND", 500)
    np.testing.assert_array_equal(ops.transfer(photo, source, relit), whole)


def test_devices_agree_to_the_last_code(opencl):
    """At most one code in a thousand lies so near a border that it rounds to the other side."""
    photo, (source, relit) = random_photo((301, 403), np.uint8), random_grids((9, 12))
    on_device = opencl.transfer(photo, source, relit).astype(int)
    difference = np.abs(on_device - NumpyOps().transfer(photo, source, relit))
    assert difference.max() <= 1 and (difference > 0).mean() < 1e-3


def test_views_are_relit_like_copies(ops):
    photo, (source, relit) = random_photo((90, 100), np.uint8)[::-2, 3::3], random_grids((4, 5))
    photo.setflags(write=False)
    np.testing.assert_array_equal(
        ops.transfer(photo, source, relit), ops.transfer(photo.copy(), source, relit)
    )


def test_strong_light_stays_finite(ops):
    photo, (source, _) = random_photo((33, 65), np.float32), random_grids((4, 5))
    got = ops.transfer(photo * 50, source, np.full_like(source, 1e30))
    assert np.isfinite(got).all()
    assert (ops.transfer(random_photo((33, 65), np.uint8), source, np.full_like(source, 1e30)) == 255).all()


def test_memory_is_bounded(ops):
    """Besides the result only a band is held: here under a quarter of the photo as floats."""
    photo, (source, relit) = np.full((1500, 2000, 3), 100, np.uint8), random_grids((9, 12))
    tracemalloc.start()
    ops.transfer(photo, source, relit)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak - photo.nbytes < photo.size


@pytest.mark.parametrize(
    ("photo", "source", "relit"),
    [
        (np.zeros((4, 4), np.uint8), np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.float32)),
        (np.zeros((4, 4, 3)), np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.float32)),
        (np.zeros((4, 4, 3), np.uint8), np.zeros((2, 2, 3), np.float32), np.zeros((2, 3, 3), np.float32)),
        (np.zeros((4, 4, 3), np.uint8), np.zeros((2, 2, 3)), np.zeros((2, 2, 3), np.float32)),
        (
            np.zeros((4, 4, 3), np.uint8),
            np.zeros((2, 2, 3), np.float32),
            np.full((2, 2, 3), np.nan, np.float32),
        ),
        (np.zeros((4, 4, 3), np.uint8), np.full((2, 2, 3), -1, np.float32), np.zeros((2, 2, 3), np.float32)),
    ],
)
def test_what_makes_no_sense_is_refused(ops, photo, source, relit):
    with pytest.raises(ValueError, match=r"must|differ"):
        ops.transfer(photo, source, relit)
