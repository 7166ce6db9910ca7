"""An operation is tried before its first use, and what fails gives way to the spare or is an error."""

import numpy as np
import pytest

from dior_rt.kernels import KernelError, NumpyOps, Stroke, open_ops
from dior_rt.kernels.guard import GuardedOps

RNG = np.random.default_rng(0)
PHOTO = RNG.integers(0, 256, (20, 30, 3), dtype=np.uint8)
LIGHT = RNG.random((2, 4, 6, 3), np.float32)


class Counting(NumpyOps):
    """NumPy's operations, which count how often photos are relit."""

    name = "counting"

    def __init__(self):
        self.relit = 0

    def _transfer(self, photo, nodes):
        self.relit += 1
        return super()._transfer(photo, nodes)


class WrongAt16(NumpyOps):
    """Relights 8 bits rightly and 16 bits wrongly, in finite numbers."""

    name = "wrong"

    def _transfer(self, photo, nodes):
        relit = super()._transfer(photo, nodes)
        return relit if photo.dtype == np.uint8 else relit // 2


def test_an_operation_is_tried_once_for_each_dtype():
    inner = Counting()
    ops = GuardedOps(inner)
    assert inner.relit == 0
    ops.transfer(PHOTO, *LIGHT)
    tried = inner.relit - 1
    assert tried > 0
    ops.transfer(PHOTO, *LIGHT)
    assert inner.relit == tried + 2
    ops.transfer(PHOTO.astype(np.uint16), *LIGHT)
    assert inner.relit == 2 * tried + 3


def test_what_fails_for_one_dtype_is_refused_for_that_alone():
    ops, deep = GuardedOps(WrongAt16()), PHOTO.astype(np.uint16) * 257
    np.testing.assert_array_equal(ops.transfer(PHOTO, *LIGHT), NumpyOps().transfer(PHOTO, *LIGHT))
    for _ in range(2):
        with pytest.raises(KernelError, match="transfer of uint16 from"):
            ops.transfer(deep, *LIGHT)


def test_a_spare_takes_over_and_it_is_said():
    ops, deep = GuardedOps(WrongAt16(), spare=NumpyOps()), PHOTO.astype(np.uint16) * 257
    ops.transfer(PHOTO, *LIGHT)
    assert ops.name == "wrong"
    np.testing.assert_array_equal(ops.transfer(deep, *LIGHT), NumpyOps().transfer(deep, *LIGHT))
    assert ops.name == "numpy"
    assert ops.reason.startswith("wrong failed its self-test of transfer of uint16")
    assert ops.reason.endswith("so the pixel kernels run on numpy")


def test_what_cannot_even_read_a_photo_is_refused_at_once():
    class Blind(NumpyOps):
        def _reduce_photo(self, picture, grid):
            return super()._reduce_photo(picture, grid) * np.float32(0.99)

    with pytest.raises(KernelError, match="reduce_photo of uint8"):
        GuardedOps(Blind(), spare=NumpyOps())


def test_what_is_opened_agrees_with_numpy_in_every_operation():
    ops, twin = open_ops("auto"), NumpyOps()
    light, mask = LIGHT[0], np.ones(LIGHT.shape[1:3], np.float32)
    strokes = [Stroke(((3.0, 4.0), (20.0, 12.0)), 5.0, (1.0, 0.5, 0.2))]
    np.testing.assert_allclose(ops.decode_srgb(PHOTO), twin.decode_srgb(PHOTO), atol=2e-6)
    np.testing.assert_array_equal(ops.encode_srgb(light, np.uint8), twin.encode_srgb(light, np.uint8))
    for found, expected in (
        (ops.reduce_strokes(light, mask, (2, 3)), twin.reduce_strokes(light, mask, (2, 3))),
        (ops.draw_strokes(strokes, (20, 30)), twin.draw_strokes(strokes, (20, 30))),
        (ops.sparsify(light, "strokes", 3), twin.sparsify(light, "strokes", 3)),
        (ops.sparsify(light, "coarse", 3), twin.sparsify(light, "coarse", 3)),
    ):
        np.testing.assert_allclose(found.light, expected.light, atol=1e-4)
        np.testing.assert_allclose(found.mask, expected.mask, atol=1e-4)
