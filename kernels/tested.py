"""Operations of a device that are held to the NumPy twin, each before its first use.

A kernel costs a device a tenth of a second to half a second to compile; most pictures need few of them.
"""

from __future__ import annotations

import threading
from typing import Final

import numpy as np

from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.selftest import try_op
from dior_rt.kernels.sparsify import Discs, Lattice
from dior_rt.kernels.types import FloatArray, KernelError, Picture, Stroke, Strokes

BYTES: Final = np.dtype(np.uint8)


class TestedOps(Ops):
    """The operations of other Ops, tried on a small picture of the same dtypes before they are trusted.

    An operation that computes wrongly raises KernelError; or, where there is a spare, the spare computes that
    picture and all that follow, and `name` and `reason` say so from then on. Safe to call from several
    threads.
    """

    __test__ = False  # for pytest, which collects what is called Test

    def __init__(self, ops: Ops, spare: Ops | None = None) -> None:
        """What every 8-bit photo needs first is tried at once: raises KernelError where it fails."""
        try_op(ops, "reduce_photo", BYTES)
        self._ops, self._spare = ops, spare
        self._passed: set[tuple[str | np.dtype, ...]] = {("reduce_photo", BYTES)}
        self._lock = threading.Lock()
        self.name, self.reason = ops.name, ops.reason

    def _trusted(self, op: str, *dtypes: np.dtype) -> Ops:
        """What computes an operation: the Ops that were given, unless they do it wrongly."""
        with self._lock:
            if self._ops is not self._spare and (op, *dtypes) not in self._passed:
                try:
                    try_op(self._ops, op, *dtypes)
                except KernelError as error:
                    self._give_up(error)
                self._passed.add((op, *dtypes))
            return self._ops

    def _give_up(self, error: KernelError) -> None:
        if self._spare is None:
            raise error
        self._ops, self.name = self._spare, self._spare.name
        self.reason = f"{error}; so the pixel kernels run on {self.name}"

    def _decode(self, picture: Picture) -> FloatArray:
        return self._trusted("decode", picture.dtype)._decode(picture)

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        return self._trusted("encode", dtype)._encode(linear, dtype)

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        return self._trusted("reduce_photo", picture.dtype)._reduce_photo(picture, grid)

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        return self._trusted("reduce_strokes", light.dtype, mask.dtype)._reduce_strokes(light, mask, grid)

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        return self._trusted("draw_strokes")._draw_strokes(strokes, size)

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        return self._trusted("coarsen")._coarsen(lumi, lattice)

    def _cut(self, lumi: FloatArray, discs: Discs) -> Strokes:
        return self._trusted("cut")._cut(lumi, discs)

    def _transfer(self, photo: Picture, nodes: FloatArray) -> Picture:
        return self._trusted("transfer", photo.dtype)._transfer(photo, nodes)
