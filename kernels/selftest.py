"""Does a device compute what the NumPy twin computes? Asked before it is trusted with a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.types import KernelError, Stroke, Strokes

#: Of the pictures: odd, and so wide that a cell of the grid holds more pixels than any device has lanes.
SIZE, GRID = (37, 149), (5, 7)
FLOAT: np.dtype = np.dtype(np.float32)

Case = tuple[str, Callable[[Ops], np.ndarray | Strokes], float]


def self_test(ops: Ops, dtypes: tuple[npt.DTypeLike, ...] = (np.uint8,)) -> None:
    """Try every operation, on small pictures of each dtype. Raises KernelError that says what is wrong."""
    for kind in dtypes:
        dtype: np.dtype = np.dtype(kind)
        for op in ("decode", "encode", "reduce_photo", "transfer"):
            try_op(ops, op, dtype)
    try_op(ops, "reduce_strokes", FLOAT, FLOAT)
    for op in ("draw_strokes", "cut", "coarsen"):
        try_op(ops, op)


def try_op(ops: Ops, op: str, *dtypes: np.dtype) -> None:
    """Run one operation on a small picture of its dtypes. Raises KernelError that says what is wrong."""
    twin = NumpyOps()
    for name, run, tolerance in _cases(op, *dtypes):
        try:
            got, expected = _arrays(run(ops)), _arrays(run(twin))
        except Exception as error:  # whatever a driver may throw
            problem = str(error).partition("\n")[0]
            raise KernelError(f"{ops.name} failed its self-test of {name} ({problem})") from error
        for a, b in zip(got, expected, strict=True):
            if a.shape != b.shape or a.dtype != b.dtype:
                raise KernelError(f"{ops.name} failed its self-test of {name}: the result is of another kind")
            worst = float(np.abs(a.astype(np.float64) - b.astype(np.float64)).max())
            # Written so that NaN fails too.
            if not worst <= tolerance:
                wrong = f"it is off by {worst:.3g} where {tolerance:g} is allowed"
                raise KernelError(f"{ops.name} failed its self-test of {name}: {wrong}")


def _cases(op: str, *dtypes: np.dtype) -> Iterator[Case]:
    """(what is tried, how to run it, largest difference allowed)."""
    rng = np.random.default_rng(20)
    light = rng.random((*SIZE, 3), np.float32)
    mask = np.where(rng.random(SIZE) < 0.3, rng.random(SIZE, np.float32), 0)
    dtype = dtypes[0] if dtypes else FLOAT
    picture = NumpyOps().encode_srgb(light, dtype)
    if op == "decode":
        yield f"decode_srgb of {dtype}", partial(Ops.decode_srgb, picture=picture), 2e-6
    elif op == "encode":
        exact = 2e-6 if dtype == FLOAT else 0
        yield f"encode_srgb to {dtype}", partial(Ops.encode_srgb, linear=light, dtype=dtype), exact
    elif op == "reduce_photo":
        yield f"reduce_photo of {dtype}", partial(Ops.reduce_photo, picture=picture, grid=GRID), 1e-5
    elif op == "transfer":
        step = {"uint8": 1, "uint16": 3}.get(dtype.name, 1e-5)
        for columns in (60, 2):  # cells of two pixels, and wide ones
            source, relit = rng.random((2, GRID[0], columns, 3), np.float32)
            relight = partial(Ops.transfer, photo=picture, source=source, relit=relit)
            yield f"transfer of {dtype} from {columns} columns", relight, step
    elif op == "reduce_strokes":
        drawn, share = light if dtype == FLOAT else picture, _of_dtype(mask, dtypes[1])
        reduce = partial(Ops.reduce_strokes, light=drawn, mask=share, grid=GRID)
        yield f"reduce_strokes of {dtype}, mask {dtypes[1]}", reduce, 1e-5
    elif op == "draw_strokes":
        strokes = [
            Stroke(((3.0, 4.0), (40.0, 20.0), (10.0, 33.0)), 6.0, (1.0, 0.5, 0.2), 2.0, 0.5),
            Stroke(((50.0, 30.0),), 0.3, (0.0, 1.0, 4.0)),
        ]
        yield "draw_strokes", partial(Ops.draw_strokes, strokes=strokes, size=SIZE), 1e-4
    elif op == "cut":
        yield "sparsify to strokes", partial(Ops.sparsify, lumi=light, mode="strokes", seed=1), 0
    else:
        yield "sparsify to coarse cells", partial(Ops.sparsify, lumi=light, mode="coarse", seed=1), 1e-5


def _of_dtype(mask: np.ndarray, dtype: np.dtype) -> np.ndarray:
    return mask if dtype == FLOAT else np.round(mask * np.iinfo(dtype).max).astype(dtype)


def _arrays(result: np.ndarray | Strokes) -> list[np.ndarray]:
    return [result.light, result.mask] if isinstance(result, Strokes) else [result]
