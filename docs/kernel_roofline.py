"""What bounds the pixel kernels on a CPU: the figures of docs/kernels.md.

    python docs/kernel_roofline.py

Processor time of all threads, medians, beside what the processor does at best: copying the photo, and
multiply-adds on whole registers. An operation's slots are the multiply-adds of whole registers that the
processor could have done in its time, for as many pixels as a register has lanes."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import process_time

import numpy as np
import pyopencl as cl

from dior_rt.kernels import OpenCLOps, list_devices

SIZE, GRID, REPEATS, LOOPS, CHAINS = (2000, 6000), (28, 80), 5, 400_000, 12
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


if __name__ == "__main__":
    main()
