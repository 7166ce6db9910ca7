"""Determinism: one seed, one answer.

On one device, the bytes of a picture are the same in every run and for any number of threads. Another device
differs by at most 1/255. The velocity is the same for any number of threads. On up to three threads it is
also the same alone and in a batch. On five threads, encode's first convolution is divided differently for a
single picture. In int8, the range of the full batch decides how activations are rounded.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from dior_rt import Relighter
from dior_rt.kernels import Strokes

THREADS = (1, 2, 3, 5)
TOP = {np.uint8: 255, np.uint16: 65535, np.float32: 1}


def photo(dtype: type, size: tuple[int, int] = (67, 90)) -> np.ndarray:
    samples = np.random.default_rng(0).random((*size, 3), np.float32)
    return samples if dtype == np.float32 else np.round(samples * TOP[dtype]).astype(dtype)


def strokes(size: tuple[int, int] = (67, 90)) -> Strokes:
    light = np.random.default_rng(1).random((*size, 3), np.float32) * 3
    mask = np.zeros(size, np.float32)
    mask[20:40, 10:70] = 1
    return Strokes(light, mask)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
def test_same_bytes_for_any_number_of_threads(bundle, hold, precision):
    pictures = []
    for threads in (*THREADS, 1):
        relighter = Relighter(bundle(precision).folder, device="cpu", ops="numpy", threads=threads)
        settings = {"steps": 3, "guidance": 2.0, "seed": 7}
        pictures.append(relighter.relight(photo(np.uint8), strokes(), **settings).picture)
    for picture in pictures[1:]:
        hold("picture, 1 to 5 threads, twice", precision, picture, pictures[0], 0, "1/255")


@pytest.mark.parametrize(("precision", "alone"), [("fp32", 2e-6), ("fp16", 1e-2), ("int8", 1e-1)])
def test_velocity_in_a_batch_and_alone(velocity, usual_feeds, hold, precision, alone):
    feeds = {name: array[[0, 3, 5]] for name, array in usual_feeds.items()}
    rows = [{name: array[i : i + 1] for name, array in feeds.items()} for i in range(3)]
    want = velocity(feeds, precision)
    scale = np.abs(want).max((1, 2, 3), keepdims=True)
    for threads in THREADS:
        got = velocity(feeds, precision, threads)
        hold("velocity, 1 to 5 threads", precision, got, want, 0, "largest value", scale)
        got = np.concatenate([velocity(row, precision, threads) for row in rows])
        exact = threads <= 3 and precision != "int8"
        case = f"velocity, row by row, {'up to 3' if threads <= 3 else '5'} threads"
        hold(case, precision, got, want, 0 if exact else alone, "largest value", scale)


@pytest.mark.parametrize("dtype", TOP)
def test_devices_agree(relighter, ops, hold, dtype):
    def relit(name: str) -> np.ndarray:
        loaded = relighter("fp32", name)
        picture = loaded.relight(photo(dtype), strokes(), steps=3, guidance=2.0, seed=7).picture
        return picture.astype(np.float64) * (255 / TOP[dtype])

    name = ops.name.split()[0]
    hold(f"picture of {dtype.__name__} against NumPy", name, relit(name), relit("numpy"), 1, "1/255")


HASHES = """
import hashlib, numpy as np
from dior_rt.kernels import Strokes, open_ops
ops, random = open_ops("auto"), np.random.default_rng(0)
photo, light = random.integers(0, 256, (67, 90, 3), dtype=np.uint8), random.random((67, 90, 3), np.float32)
mask = (random.random((67, 90)) < 0.2).astype(np.float32)
grid = ops.reduce_photo(photo, (16, 24))
strokes = ops.reduce_strokes(light, mask, (16, 24))
arrays = grid, strokes.light, ops.transfer(photo, grid, grid * 1.7), ops.sparsify(light, "strokes", 3).light
print(hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest())
"""


def test_kernels_give_the_same_bytes_in_any_process():
    """With one worker thread and with three, and whatever Python's own hashes are."""
    seen = set()
    for threads, seed in (("1", "0"), ("3", "1")):
        environment = {
            **os.environ,
            "POCL_MAX_PTHREAD_COUNT": threads,
            "OMP_NUM_THREADS": threads,
            "PYTHONHASHSEED": seed,
        }
        run = subprocess.run(
            [sys.executable, "-c", HASHES], env=environment, capture_output=True, text=True, check=True
        )
        seen.add(run.stdout)
    assert len(seen) == 1
