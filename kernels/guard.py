"""Ops of a device that are compared with the NumPy twin, each operation before its first use.

A device takes a tenth of a second to half a second to compile a kernel, and most photos need few of them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from dior_rt.kernels.ops import Ops
from dior_rt.kernels.selftest import OPERATIONS, Dtypes, check_operation
from dior_rt.kernels.types import KernelError

BYTES: Final = np.dtype(np.uint8)


def _guarded(name: str) -> Callable[..., Any]:
    """Return the method that runs an operation on the Ops that passed its test."""
    operation = OPERATIONS[name]

    def run(self: GuardedOps, *arguments: Any) -> Any:
        ops = self._trusted(name, operation.dtypes(*arguments))
        return getattr(ops, operation.method)(*arguments)

    return run


class GuardedOps(Ops):
    """The operations of other Ops, each tested on a small picture of the same dtypes before it is trusted.

    An operation that computes wrongly raises KernelError. If there is a `spare`, the spare computes this
    picture and all later ones instead, and `name` and `reason` say so from then on. Safe to call from several
    threads.
    """

    def __init__(self, ops: Ops, spare: Ops | None = None) -> None:
        """Test the operation that every 8-bit photo needs first. Raises KernelError if it fails."""
        check_operation(ops, "reduce_photo", BYTES)
        self._ops, self._spare = ops, spare
        self._passed: set[tuple[str, Dtypes]] = {("reduce_photo", (BYTES,))}
        self._lock = threading.Lock()
        self.name, self.reason = ops.name, ops.reason

    def _trusted(self, name: str, dtypes: Dtypes) -> Ops:
        """Return the Ops that compute an operation: the given ones, unless they failed a test."""
        with self._lock:
            if self._ops is not self._spare and (name, dtypes) not in self._passed:
                try:
                    check_operation(self._ops, name, *dtypes)
                except KernelError as error:
                    self._give_up(error)
                self._passed.add((name, dtypes))
            return self._ops

    def _give_up(self, error: KernelError) -> None:
        if self._spare is None:
            raise error
        self._ops, self.name = self._spare, self._spare.name
        self.reason = f"{error}; so the pixel kernels run on {self.name}"

    _decode = _guarded("decode")
    _encode = _guarded("encode")
    _reduce_photo = _guarded("reduce_photo")
    _reduce_strokes = _guarded("reduce_strokes")
    _draw_strokes = _guarded("draw_strokes")
    _coarsen = _guarded("coarsen")
    _cut = _guarded("cut")
    _transfer = _guarded("transfer")
