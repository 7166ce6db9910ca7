"""Does a device compute what the NumPy twin computes? Asked once, before it is trusted with a picture."""

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

Case = tuple[str, Callable[[Ops], np.ndarray | Strokes], float]


def self_test(ops: Ops, dtypes: tuple[npt.DTypeLike, ...] = (np.uint8,)) -> None:
    """Run every op on a small fixed picture of each dtype. Raises KernelError that says what is wrong.

    One dtype is enough to know a device; the kernels of another are built, for a second or two, when first
    used."""
    twin = NumpyOps()
    for name, run, tolerance in _cases(dtypes):
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


def _cases(dtypes: tuple[npt.DTypeLike, ...]) -> Iterator[Case]:
    """(op, how to run it, largest difference allowed)."""
    rng = np.random.default_rng(20)
    light = rng.random((*SIZE, 3), np.float32)
    mask = np.where(rng.random(SIZE) < 0.3, rng.random(SIZE, np.float32), 0)
    narrow = rng.random((2, GRID[0], 60, 3), np.float32)  # cells of two pixels
    strokes = [
        Stroke(((3.0, 4.0), (40.0, 20.0), (10.0, 33.0)), 6.0, (1.0, 0.5, 0.2), 2.0, 0.5),
        Stroke(((50.0, 30.0),), 0.3, (0.0, 1.0, 4.0)),
    ]
    for dtype in (np.dtype(kind) for kind in dtypes):
        picture = NumpyOps().encode_srgb(light, dtype)
        exact = 2e-6 if dtype == np.float32 else 0
        step = {"uint8": 1, "uint16": 3}.get(dtype.name, 1e-5)
        yield f"decode_srgb of {dtype}", partial(Ops.decode_srgb, picture=picture), 2e-6
        yield f"encode_srgb to {dtype}", partial(Ops.encode_srgb, linear=light, dtype=dtype), exact
        yield f"reduce_photo of {dtype}", partial(Ops.reduce_photo, picture=picture, grid=GRID), 1e-5
        for columns, (source, relit) in {60: narrow, 2: narrow[:, :, :2]}.items():
            relight = partial(Ops.transfer, photo=picture, source=source, relit=relit)
            yield f"transfer of {dtype} from {columns} columns", relight, step
    yield "reduce_strokes", partial(Ops.reduce_strokes, light=light, mask=mask, grid=GRID), 1e-5
    yield "draw_strokes", partial(Ops.draw_strokes, strokes=strokes, size=SIZE), 1e-4
    yield "sparsify to strokes", partial(Ops.sparsify, lumi=light, mode="strokes", seed=1), 0
    yield "sparsify to coarse cells", partial(Ops.sparsify, lumi=light, mode="coarse", seed=1), 1e-5


def _arrays(result: np.ndarray | Strokes) -> list[np.ndarray]:
    return [result.light, result.mask] if isinstance(result, Strokes) else [result]
