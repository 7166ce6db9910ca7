"""Does a device compute what the NumPy twin computes? Asked once, before it is trusted with a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.types import KernelError, Stroke, Strokes

Result = np.ndarray | Strokes


def self_test(ops: Ops) -> None:
    """Run every op on a small fixed picture. Raises KernelError that says which op differs and by how much."""
    twin = NumpyOps()
    for name, run, tolerance in _cases():
        try:
            got, expected = _arrays(run(ops)), _arrays(run(twin))
        except KernelError:
            raise
        except Exception as error:
            raise KernelError(f"{ops.name} failed its self-test of {name} ({error}).") from error
        for a, b in zip(got, expected, strict=True):
            if a.shape != b.shape or a.dtype != b.dtype:
                raise KernelError(
                    f"{ops.name} failed its self-test of {name}: it returned another kind of array."
                )
            worst = float(np.abs(a.astype(np.float64) - b.astype(np.float64)).max())
            # Written so that NaN fails too.
            if not worst <= tolerance:
                raise KernelError(
                    f"{ops.name} failed its self-test of {name}: it is off by {worst:.3g} where {tolerance:g} is allowed."
                )


def _cases() -> Iterator[tuple[str, Callable[[Ops], Result], float]]:
    """(op, how to run it, largest difference allowed), on odd sizes and every dtype that a photo may have."""
    rng = np.random.default_rng(20)
    light = rng.random((37, 53, 3), np.float32)
    mask = (rng.random((37, 53)) < 0.3).astype(np.float32)
    source, relit = rng.random((2, 5, 7, 3), np.float32)
    strokes = [
        Stroke(((3.0, 4.0), (40.0, 20.0), (10.0, 33.0)), 6.0, (1.0, 0.5, 0.2), 2.0, 0.5),
        Stroke(((50.0, 30.0),), 0.3, (0.0, 1.0, 4.0)),
    ]
    pictures: list[tuple[np.ndarray, float]] = [
        ((light * 255).astype(np.uint8), 1),
        ((light * 65535).astype(np.uint16), 3),
        (light, 1e-5),
    ]
    for picture, step in pictures:
        kind = picture.dtype
        yield f"decode_srgb of {kind}", lambda ops, p=picture: ops.decode_srgb(p), 2e-6
        yield (
            f"encode_srgb to {kind}",
            lambda ops, k=kind: ops.encode_srgb(light, k),
            0 if step >= 1 else 2e-6,
        )
        yield f"reduce_photo of {kind}", lambda ops, p=picture: ops.reduce_photo(p, (5, 7)), 1e-5
        yield f"reduce_strokes of {kind}", lambda ops, p=picture: ops.reduce_strokes(p, mask, (5, 7)), 1e-5
        yield f"transfer of {kind}", lambda ops, p=picture: ops.transfer(p, source, relit), step
    yield "draw_strokes", lambda ops: ops.draw_strokes(strokes, (37, 53)), 1e-4
    yield "sparsify to strokes", lambda ops: ops.sparsify(light, "strokes", 1), 0
    yield "sparsify to coarse cells", lambda ops: ops.sparsify(light, "coarse", 1), 1e-5


def _arrays(result: Result) -> list[np.ndarray]:
    return [result.light, result.mask] if isinstance(result, Strokes) else [result]
