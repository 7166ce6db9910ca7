"""What bounds the pixel kernels on a CPU: the figures of docs/kernels.md.

    python -m tools.kernel_roofline

Processor time of all threads, medians, beside what the processor does at best: copying the photo, and
multiply-adds on whole registers. An operation's slots are the multiply-adds of whole registers that the
processor could have done in its time, for as many pixels as a register has lanes. Then both operations at
sizes from 0.1 to 100 megapixels, and the straight line through them: a call's own cost, and a pixel's."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import process_time

import numpy as np
import pyopencl as cl

from dior_rt.kernels import OpenCLOps, list_devices
from tools.command import start

SIZE, GRID, REPEATS, LOOPS, CHAINS = (2000, 6000), (28, 80), 5, 400_000, 12
MEGAPIXELS, LIGHT_GRID = (0.1, 0.2, 0.4, 0.8, 1.6, 3, 6, 12, 24, 48, 100), (52, 80)
PEAK = """
__kernel void peak(__global float%(n)d *x, int loops) {
  float%(n)d m = x[0] * 0.5f + 0.999f, a[%(chains)d];
  for (int i = 0; i < %(chains)d; ++i) a[i] = x[i];
  for (int k = 0; k < loops; ++k)
#pragma unroll
    for (int i = 0; i < %(chains)d; ++i) a[i] = a[i] * m + m;
  for (int i = 0; i < %(chains)d; ++i) x[i] = a[i];
}
"""


def seconds(action: Callable[[], object]) -> float:
    """Processor time of one call."""
    start = process_time()
    action()
    return process_time() - start


def main() -> None:
    """Measure what bounds the pixel kernels on this CPU."""
    device = next(device for device in list_devices() if device.type == "cpu")
    ops, context = OpenCLOps(device), cl.Context([device.handle])
    lanes, queue = device.handle.preferred_vector_width_float, cl.CommandQueue(context)
    kernel = cl.Program(context, PEAK % {"n": lanes, "chains": CHAINS}).build().peak
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, CHAINS * lanes * 4)
    kernel.set_args(buffer, np.int32(LOOPS))

    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (*SIZE, 3), np.uint8)
    source, relit = rng.random((2, *GRID, 3), np.float32)
    target = photo.copy()
    actions = {
        "copy": lambda: np.copyto(target, photo),
        "copy into new memory": lambda: photo.copy(),
        "reduce_photo": lambda: ops.reduce_photo(photo, GRID),
        "transfer": lambda: ops.transfer(photo, source, relit),
    }

    def peak() -> float:
        return seconds(lambda: cl.enqueue_nd_range_kernel(queue, kernel, (1,), (1,)).wait())

    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in actions}
    for _ in range(REPEATS + 1):
        for name, action in actions.items():
            measured[name].append((seconds(action), LOOPS * CHAINS / peak()))
    pixels = SIZE[0] * SIZE[1]
    print(f"{device.name}: {lanes} lanes")
    for name, pairs in measured.items():
        slots = median(taken * rate for taken, rate in pairs[1:]) / (pixels / lanes)
        took = median(taken for taken, _ in pairs[1:])
        print(f"{name:21} {took / pixels * 1e9:6.2f} ns a pixel {slots:7.1f} slots for {lanes} pixels")
    by_size(ops)


def by_size(ops: OpenCLOps) -> None:
    """Both operations at every size, by turns, and the line with the least relative error."""
    rng = np.random.default_rng(0)
    relit = rng.random((*LIGHT_GRID, 3), np.float32)
    taken: dict[float, list[float]] = {megapixels: [] for megapixels in MEGAPIXELS}
    for _ in range(REPEATS):
        for megapixels in MEGAPIXELS:
            height = round((megapixels * 1e6 / 1.5) ** 0.5)
            photo = rng.integers(0, 256, (height, round(1.5 * height), 3), np.uint8)
            ops.reduce_photo(photo, LIGHT_GRID)  # memory touched before
            taken[megapixels].append(
                seconds(lambda: ops.transfer(photo, ops.reduce_photo(photo, LIGHT_GRID), relit))  # noqa: B023
            )
    took = np.array([median(each) for each in taken.values()])
    terms = np.stack([np.ones(len(took)), np.array(MEGAPIXELS) * 1e6], 1)
    call, pixel = np.linalg.lstsq(terms / took[:, None], np.ones(len(took)), rcond=None)[0]
    print(f"line: {call * 1e3:.2f} ms a call, {pixel * 1e9:.2f} ns a pixel")
    for megapixels, each in zip(MEGAPIXELS, took, strict=True):
        line = call + pixel * megapixels * 1e6
        print(f"{megapixels:5} megapixels {each * 1e3:8.2f} ms, {each / line:.2f} of the line")


if __name__ == "__main__":
    start(main)
