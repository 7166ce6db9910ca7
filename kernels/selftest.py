"""The table of operations, and the test that a device must pass before it is trusted with a picture.

Each operation names its method of `Ops`, the dtypes that select a build of its kernel, and small cases with
the largest difference to the NumPy twin that is allowed. A new operation is one more entry of `OPERATIONS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.types import FloatArray, KernelError, Picture, Stroke, Strokes

#: Size of the test pictures: odd, and so wide that a cell of GRID has more pixels than any device has lanes.
SIZE, GRID = (37, 149), (5, 7)
FLOAT: Final[np.dtype] = np.dtype(np.float32)

Dtypes = tuple[np.dtype, ...]


@dataclass(frozen=True)
class Case:
    """One run of an operation. label: for messages. tolerance: the largest difference to the NumPy twin."""

    label: str
    run: Callable[[Ops], np.ndarray | Strokes]
    tolerance: float


@dataclass(frozen=True)
class Operation:
    """One operation of `Ops`.

    method: the name of the method that a backend implements. dtypes: the dtypes that select a build of the
    kernel, read from the method's arguments. cases: what is run to test it with those dtypes. tested_dtypes:
    the dtypes of `self_test`, given the dtype of the pictures.
    """

    method: str
    dtypes: Callable[..., Dtypes]
    cases: Callable[..., Iterator[Case]]
    tested_dtypes: Callable[[np.dtype], Dtypes]


def self_test(ops: Ops, dtypes: tuple[npt.DTypeLike, ...] = (np.uint8,)) -> None:
    """Test every operation on small pictures of each dtype. Raises KernelError that says what is wrong."""
    for name, operation in OPERATIONS.items():
        for tested in dict.fromkeys(operation.tested_dtypes(np.dtype(kind)) for kind in dtypes):
            check_operation(ops, name, *tested)


def check_operation(ops: Ops, name: str, *dtypes: np.dtype) -> None:
    """Run one operation of `OPERATIONS` on small pictures. Raises KernelError that says what is wrong."""
    twin = NumpyOps()
    for case in OPERATIONS[name].cases(*dtypes):
        try:
            got, expected = _arrays(case.run(ops)), _arrays(case.run(twin))
        except Exception as error:  # a driver may raise anything
            problem = str(error).partition("\n")[0]
            raise KernelError(f"{ops.name} failed its self-test of {case.label} ({problem})") from error
        for a, b in zip(got, expected, strict=True):
            if a.shape != b.shape or a.dtype != b.dtype:
                raise KernelError(f"{ops.name} failed its self-test of {case.label}: another shape or dtype")
            worst = float(np.abs(a.astype(np.float64) - b.astype(np.float64)).max())
            if not worst <= case.tolerance:  # written so that NaN fails, too
                wrong = f"it is off by {worst:.3g} where {case.tolerance:g} is allowed"
                raise KernelError(f"{ops.name} failed its self-test of {case.label}: {wrong}")


@cache
def _light() -> FloatArray:
    light = np.random.default_rng(20).random((*SIZE, 3), np.float32)
    light.setflags(write=False)
    return light


def _picture(dtype: np.dtype) -> Picture:
    return NumpyOps().encode_srgb(_light(), dtype)


def _mask(dtype: np.dtype) -> np.ndarray:
    rng = np.random.default_rng(21)
    mask = np.where(rng.random(SIZE) < 0.3, rng.random(SIZE, np.float32), 0)
    return mask if dtype == FLOAT else np.round(mask * np.iinfo(dtype).max).astype(dtype)


def _decode_cases(dtype: np.dtype) -> Iterator[Case]:
    yield Case(f"decode_srgb of {dtype}", partial(Ops.decode_srgb, picture=_picture(dtype)), 2e-6)


def _encode_cases(dtype: np.dtype) -> Iterator[Case]:
    tolerance = 2e-6 if dtype == FLOAT else 0
    yield Case(f"encode_srgb to {dtype}", partial(Ops.encode_srgb, linear=_light(), dtype=dtype), tolerance)


def _reduce_photo_cases(dtype: np.dtype) -> Iterator[Case]:
    run = partial(Ops.reduce_photo, picture=_picture(dtype), grid=GRID)
    yield Case(f"reduce_photo of {dtype}", run, 1e-5)


def _reduce_strokes_cases(light: np.dtype, mask: np.dtype) -> Iterator[Case]:
    drawn = _light() if light == FLOAT else _picture(light)  # the floats of strokes are linear
    run = partial(Ops.reduce_strokes, light=drawn, mask=_mask(mask), grid=GRID)
    yield Case(f"reduce_strokes of {light}, mask {mask}", run, 1e-5)


def _draw_strokes_cases() -> Iterator[Case]:
    strokes = [
        Stroke(((3.0, 4.0), (40.0, 20.0), (10.0, 33.0)), 6.0, (1.0, 0.5, 0.2), 2.0, 0.5),
        Stroke(((50.0, 30.0),), 0.3, (0.0, 1.0, 4.0)),
    ]
    yield Case("draw_strokes", partial(Ops.draw_strokes, strokes=strokes, size=SIZE), 1e-4)


def _cut_cases() -> Iterator[Case]:
    yield Case("sparsify to strokes", partial(Ops.sparsify, lumi=_light(), mode="strokes", seed=1), 0)


def _coarsen_cases() -> Iterator[Case]:
    yield Case("sparsify to coarse cells", partial(Ops.sparsify, lumi=_light(), mode="coarse", seed=1), 1e-5)


def _transfer_cases(dtype: np.dtype) -> Iterator[Case]:
    tolerance = {"uint8": 1, "uint16": 3}.get(dtype.name, 1e-5)
    rng = np.random.default_rng(22)
    for columns in (60, 2):  # narrow cells of two pixels, and wide cells: two kernels
        source, relit = rng.random((2, GRID[0], columns, 3), np.float32)
        run = partial(Ops.transfer, photo=_picture(dtype), source=source, relit=relit)
        yield Case(f"transfer of {dtype} from {columns} columns", run, tolerance)


def _of_picture(picture: Picture, *others: Any) -> Dtypes:
    return (picture.dtype,)


def _same(dtype: np.dtype) -> Dtypes:
    return (dtype,)


def _none(*arguments: Any) -> Dtypes:
    return ()


OPERATIONS: Final = {
    "decode": Operation("_decode", _of_picture, _decode_cases, _same),
    "encode": Operation("_encode", lambda linear, dtype: (dtype,), _encode_cases, _same),
    "reduce_photo": Operation("_reduce_photo", _of_picture, _reduce_photo_cases, _same),
    "transfer": Operation("_transfer", _of_picture, _transfer_cases, _same),
    "reduce_strokes": Operation(
        "_reduce_strokes",
        lambda light, mask, grid: (light.dtype, mask.dtype),
        _reduce_strokes_cases,
        lambda dtype: (FLOAT, FLOAT),
    ),
    "draw_strokes": Operation("_draw_strokes", _none, _draw_strokes_cases, _none),
    "cut": Operation("_cut", _none, _cut_cases, _none),
    "coarsen": Operation("_coarsen", _none, _coarsen_cases, _none),
}


def _arrays(result: np.ndarray | Strokes) -> list[np.ndarray]:
    return [result.light, result.mask] if isinstance(result, Strokes) else [result]
