"""Describe the machine, and measure what it can do at best (its rooflines)."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from dior_rt.bench.flops import Step, product_rate
from dior_rt.bench.plan import usable_cores
from dior_rt.bundle import Bundle

GEMM_SIDE = 1024
COPY_BYTES = 1 << 28
TRIES = 5

PACKAGES = ("dior-rt", "numpy", "onnxruntime", "pyopencl", "pillow")


@dataclass(frozen=True)
class Machine:
    """The hardware and versions. memory_bytes: None if unknown."""

    system: str
    cpu: str
    cores: int
    usable_cores: int
    memory_bytes: int | None
    versions: dict[str, str]


@dataclass(frozen=True)
class Rooflines:
    """The best rates of the machine.

    gemm: floating-point operations per second of NumPy's float32 product of two 1024 x 1024 matrices, on as
    many threads as its BLAS uses. copy: bytes read and written per second while copying 256 MiB, by kernels
    ("numpy" in main memory, "opencl:0" in that device's memory). products: `product_rate` by the name of
    the step.
    """

    gemm: float
    copy: dict[str, float]
    products: dict[str, float]


def this_machine() -> Machine:
    """Return the machine that this process runs on."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:  # ONNX Runtime has several package names
            continue
    return Machine(platform.platform(), _cpu(), os.cpu_count() or 1, usable_cores(), _memory(), versions)


def measure_rooflines(ops: Sequence[str], steps: Mapping[Step, Bundle]) -> Rooflines:
    """Measure once; each figure is the best or the median of a few tries.

    ops: the kernels whose memory is measured. steps: the steps whose products are measured, and their
    bundles.
    """
    copies = {name: _opencl_copy(name) for name in ops if name != "numpy"}
    products = {step.name: product_rate(bundle, step) for step, bundle in steps.items()}
    return Rooflines(_gemm(), {"numpy": _numpy_copy(), **copies}, products)


def medians(measured: Sequence[Rooflines]) -> Rooflines:
    """Return the median of each figure."""
    first = measured[0]
    return Rooflines(
        median(one.gemm for one in measured),
        {name: median(one.copy[name] for one in measured) for name in first.copy},
        {name: median(one.products[name] for one in measured) for name in first.products},
    )


def _gemm() -> float:
    a = np.random.Generator(np.random.PCG64(0)).standard_normal((GEMM_SIDE, GEMM_SIDE), np.float32)
    out = np.empty_like(a)
    return 2 * GEMM_SIDE**3 / _best(lambda: np.matmul(a, a, out=out))


def _numpy_copy() -> float:
    source, target = np.ones(COPY_BYTES, np.uint8), np.zeros(COPY_BYTES, np.uint8)
    return 2 * COPY_BYTES / _best(lambda: np.copyto(target, source))


def _opencl_copy(name: str) -> float:
    import pyopencl as cl

    from dior_rt.kernels import list_devices

    device = list_devices()[int(name.partition(":")[2])]
    context = cl.Context([device.handle])
    queue, flags = cl.CommandQueue(context), cl.mem_flags.READ_WRITE
    source, target = cl.Buffer(context, flags, COPY_BYTES), cl.Buffer(context, flags, COPY_BYTES)
    for buffer in (source, target):  # the system may not have mapped memory that was never written
        cl.enqueue_fill_buffer(queue, buffer, np.array(1, np.uint8), 0, COPY_BYTES).wait()
    return 2 * COPY_BYTES / _best(lambda: cl.enqueue_copy(queue, target, source).wait())


def _best(action: Callable[[], object]) -> float:
    seconds = []
    for _ in range(TRIES + 1):  # the first one starts threads and maps memory
        start = perf_counter()
        action()
        seconds.append(perf_counter() - start)
    return min(seconds[1:])


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _memory() -> int | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None
