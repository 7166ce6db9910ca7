"""Strokes cut from a dense map: seeded, the same on every device, with the map's values."""

import hashlib

import numpy as np
import pytest
from skimage.measure import label

from dior_rt.kernels import NumpyOps
from dior_rt.kernels.sparsify import MAX_STROKES, draw_lattice, draw_walks

SIZES = [(1, 1), (1, 7), (9, 1), (33, 65), (257, 129)]
MODES = ["strokes", "coarse", "dense"]


def random_map(size, seed=0):
    return np.random.default_rng(seed).random((*size, 3), np.float32) * 3


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", SIZES)
def test_one_seed_is_one_mask_on_every_device(opencl, size, mode):
    lumi = random_map(size)
    for seed in range(20):
        on_device, on_host = opencl.sparsify(lumi, mode, seed), NumpyOps().sparsify(lumi, mode, seed)
        np.testing.assert_array_equal(on_device.mask, on_host.mask)
        np.testing.assert_allclose(on_device.light, on_host.light, rtol=1e-5)


@pytest.mark.parametrize(
    ("mode", "digest"), [("strokes", "42be5591b7f0dd43"), ("coarse", "01c4a473db7fd545")]
)
def test_one_seed_is_one_mask_for_ever(ops, mode, digest):
    y, x = np.mgrid[:96, :128].astype(np.float32)
    lumi = np.repeat((x + y)[..., None], 3, 2)
    masks = np.stack([ops.sparsify(lumi, mode, seed).mask for seed in range(4)])
    assert hashlib.sha256(np.packbits(masks > 0).tobytes()).hexdigest()[:16] == digest


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", SIZES)
def test_something_is_always_specified_and_the_rest_is_empty(ops, size, mode):
    for seed in range(10):
        strokes = ops.sparsify(random_map(size), mode, seed)
        assert strokes.light.dtype == strokes.mask.dtype == np.float32
        assert strokes.light.shape == (*size, 3) and strokes.mask.shape == size
        assert set(np.unique(strokes.mask)) <= {0, 1} and strokes.mask.any()
        assert not strokes.light[strokes.mask == 0].any()


@pytest.mark.parametrize("mode", ["strokes", "dense"])
def test_a_pixel_under_a_stroke_keeps_its_value(ops, mode):
    lumi = random_map((61, 47))
    strokes = ops.sparsify(lumi, mode, 5)
    np.testing.assert_array_equal(strokes.light[strokes.mask > 0], lumi[strokes.mask > 0])


def test_a_dense_map_is_a_copy_of_all(ops):
    lumi = random_map((9, 8))
    strokes = ops.sparsify(lumi, "dense", 0)
    lumi[:] = 0
    assert (strokes.mask == 1).all() and strokes.light.any()


@pytest.mark.parametrize("size", [(33, 65), (257, 129)])
def test_a_coarse_cell_holds_the_mean_of_its_pixels(ops, size):
    lumi = random_map(size)
    for seed in range(5):
        lattice, strokes = draw_lattice(*size, seed), ops.sparsify(lumi, "coarse", seed)
        for i, j in np.ndindex(lattice.keep.shape):
            top, left = i * lattice.cell - lattice.oy, j * lattice.cell - lattice.ox
            cell = slice(max(top, 0), top + lattice.cell), slice(max(left, 0), left + lattice.cell)
            assert (strokes.mask[cell] == lattice.keep[i, j]).all()
            if lattice.keep[i, j]:
                mean = lumi[cell].mean((0, 1), dtype=np.float64)
                np.testing.assert_allclose(
                    strokes.light[cell], np.broadcast_to(mean, lumi[cell].shape), rtol=1e-5
                )


def test_coarse_cells_run_from_fine_to_coarse_and_from_few_to_many():
    lattices = [draw_lattice(96, 128, seed) for seed in range(300)]
    cells, kept = [lattice.cell for lattice in lattices], [lattice.keep.mean() for lattice in lattices]
    assert min(cells) == 3 and max(cells) >= 30
    assert min(kept) < 0.2 and max(kept) > 0.8


def test_strokes_are_one_to_eight_and_of_many_widths():
    counts, widths = set(), []
    for seed in range(300):
        discs = draw_walks(random_map((96, 128)), seed, None)
        widths += (np.unique(discs.radius) / 8).tolist()
        apart = np.hypot(np.diff(discs.x), np.diff(discs.y)) > discs.radius[1:]
        counts.add(int(apart.sum()) + 1)
        assert (discs.x >= 0).all() and (discs.x <= 128 * 16).all()
        assert (discs.y >= 0).all() and (discs.y <= 96 * 16).all()
    assert counts >= set(range(1, MAX_STROKES + 1))
    assert min(widths) < 0.02 * 96 and 0.075 * 96 < max(widths) <= 0.081 * 96


def test_a_stroke_is_connected(ops):
    """However thin: the number of pieces is at most the number of strokes."""
    for size in [(16, 16), (64, 64), (200, 90)]:
        for seed in range(30):
            mask = ops.sparsify(random_map(size), "strokes", seed).mask
            assert 1 <= label(mask > 0, connectivity=2).max() <= MAX_STROKES


def test_strokes_start_in_bright_and_in_dark_regions(ops):
    lumi = np.full((64, 64, 3), 0.5, np.float32)
    lumi[:8, :8], lumi[-8:, -8:] = 0.0, 9.0
    lumi[8:-8] += np.random.default_rng(0).random((48, 64, 3), np.float32) * 0.01
    bright = dark = 0
    for seed in range(60):
        drawn = ops.sparsify(lumi, "strokes", seed)
        bright += (drawn.light == 9).any()
        dark += ((drawn.light == 0).all(-1) & (drawn.mask > 0)).any()
    assert bright > 5 and dark > 5


def test_strokes_start_where_the_interest_is(ops):
    interest = np.zeros((48, 64), np.float32)
    interest[30, 50], interest[10, 5] = 3, 1
    seen = np.zeros(2)
    for seed in range(200):
        discs = draw_walks(random_map((48, 64)), seed, interest)
        first = (discs.y[0] // 16, discs.x[0] // 16)
        assert first in [(30, 50), (10, 5)]
        seen += first == (30, 50), first == (10, 5)
        if seed < 20:
            mask = ops.sparsify(random_map((48, 64)), "strokes", seed, interest).mask
            assert mask[30, 50] or mask[10, 5]
    assert seen[0] / seen.sum() == pytest.approx(0.75, abs=0.1)


def test_interest_in_nothing_is_no_interest(ops):
    lumi = random_map((32, 32))
    np.testing.assert_array_equal(
        ops.sparsify(lumi, "strokes", 3, np.zeros((32, 32), np.float32)).mask,
        ops.sparsify(lumi, "strokes", 3).mask,
    )


def test_seeds_differ():
    lumi = random_map((32, 32))
    for mode in ("strokes", "coarse"):
        assert len({NumpyOps().sparsify(lumi, mode, seed).mask.tobytes() for seed in range(20)}) > 15


def test_views_are_cut_like_copies(ops):
    lumi = random_map((70, 80))[::2, ::-1]
    for mode in MODES:
        np.testing.assert_array_equal(
            ops.sparsify(lumi, mode, 2).light, ops.sparsify(lumi.copy(), mode, 2).light
        )


@pytest.mark.parametrize(
    ("lumi", "mode", "interest"),
    [
        (np.zeros((4, 4, 3)), "dense", None),
        (np.zeros((4, 4), np.float32), "dense", None),
        (np.zeros((0, 4, 3), np.float32), "dense", None),
        (np.zeros((4, 4, 3), np.float32), "sparse", None),
        (np.zeros((4, 4, 3), np.float32), "strokes", np.zeros((4, 5), np.float32)),
        (np.zeros((4, 4, 3), np.float32), "strokes", np.full((4, 4), -1, np.float32)),
        (np.zeros((4, 4, 3), np.float32), "strokes", np.full((4, 4), np.nan, np.float32)),
    ],
)
def test_what_makes_no_sense_is_refused(ops, lumi, mode, interest):
    with pytest.raises(ValueError, match="must"):
        ops.sparsify(lumi, mode, 0, interest)
