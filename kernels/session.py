"""An opened OpenCL device: programs, buffers and launches. It contains nothing about pictures."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
import pyopencl as cl

from dior_rt.kernels.types import Device, KernelError

FOLDER = Path(__file__).parent
SOURCES = ("curve.cl", "reduce.cl", "transfer.cl", "draw.cl", "sparsify.cl")
P = ParamSpec("P")
T = TypeVar("T")
#: How many neighbours one work item processes on a CPU.
CPU_RUN = 4096


def _translated(method: Callable[P, T]) -> Callable[P, T]:
    """Return the method, with errors of OpenCL turned into a KernelError of one sentence."""

    @wraps(method)
    def translated(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(*args, **kwargs)
        except cl.Error as error:
            problem = str(error).partition("\n")[0]
            raise KernelError(f"the OpenCL device failed ({problem})") from error

    return translated


class Session:
    """An opened device, safe to use from several threads: each has its own kernels; a lock guards the rest.

    If the device shares the host's memory, the buffers are the arrays themselves and nothing is copied.
    """

    def __init__(self, device: Device) -> None:
        """Open the device. Programs are built when first needed. Raises KernelError if opening fails."""
        self.name = f"opencl:{device.index} ({device.name})"
        try:
            self._context = cl.Context([device.handle])
            self._queue = cl.CommandQueue(self._context)
            #: How many floats the device processes at a time.
            self.lanes = max(1, min(16, device.handle.preferred_vector_width_float))
            self._shares_memory = bool(device.handle.host_unified_memory)
        except cl.Error as error:
            raise KernelError(f"{self.name} cannot be opened ({error})") from error
        self._process = os.getpid()
        self._run = CPU_RUN if device.type == "cpu" else 1
        self._lock, self._local = threading.Lock(), threading.local()
        self._programs: dict[tuple[str, ...], cl.Program] = {}
        self._constants: dict[int, tuple[np.ndarray, cl.Buffer]] = {}

    @_translated
    def kernel(self, name: str, **defines: object) -> cl.Kernel:
        """Return the kernel of that name, from the program built with -Dkey=value for each of `defines`.

        All sources make one program, for a build costs a quarter of a second and more sources hardly
        anything."""
        if os.getpid() != self._process:
            raise KernelError(
                f"{self.name} was opened before the process was forked, and its driver's threads were not "
                "copied: start processes by the method 'spawn'"
            )
        options = tuple(f"-D{key}={value}" for key, value in defines.items())
        with self._lock:
            program = self._programs.get(options)
            if program is None:
                text = "\n".join((FOLDER / source).read_text("utf-8") for source in SOURCES)
                program = cl.Program(self._context, text).build(["-cl-std=CL1.2", *options])
                self._programs[options] = program
        kernels = self._kernels_of_thread()
        if (name, options) not in kernels:
            kernels[name, options] = cl.Kernel(program, name)
        return kernels[name, options]

    def _kernels_of_thread(self) -> dict[tuple[str, tuple[str, ...]], cl.Kernel]:
        """Return the kernels of this thread. A kernel stores its arguments, and making one takes a
        millisecond."""
        if not hasattr(self._local, "kernels"):
            self._local.kernels = {}
        return self._local.kernels

    @_translated
    def launch(self, kernel: cl.Kernel, count: int, rows: int, *args: cl.Buffer | int | None) -> None:
        """Run the kernel over `rows` rows of `count` items and wait, so that no buffer has to outlive the
        call.

        One work item processes up to `run` neighbours on a row; the kernel gets `run` as its last argument.
        CPUs need few, long loops and work groups of one item, because PoCL compiles a kernel again for
        every shape of group. GPUs need many items. None is a null pointer.
        """
        items = -(-count // self._run), rows
        group = (1, 1) if self._run > 1 else None
        for place, arg in enumerate((*args, self._run)):
            kernel.set_arg(place, np.int32(arg) if isinstance(arg, int) else arg)
        cl.enqueue_nd_range_kernel(self._queue, kernel, items, group).wait()

    @_translated
    def constant(self, array: np.ndarray) -> cl.Buffer:
        """Return a copy of an array on the device. It lives as long as the session and is made once."""
        with self._lock:
            if id(array) not in self._constants:
                flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
                self._constants[id(array)] = array, cl.Buffer(self._context, flags, hostbuf=array)
            return self._constants[id(array)][1]

    @_translated
    def scratch(self, size: int) -> cl.Buffer:
        """Return an uninitialised buffer of `size` bytes on the device."""
        return cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)

    @_translated
    def clear(self, buffer: cl.Buffer) -> None:
        """Set every byte to 0."""
        cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.uint8), 0, buffer.size).wait()

    @_translated
    def input(self, array: np.ndarray) -> cl.Buffer:
        """Return a buffer with the array: the array itself if it is contiguous and the memory is shared."""
        share = cl.mem_flags.USE_HOST_PTR if self._shares_memory else cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self._context, cl.mem_flags.READ_ONLY | share, hostbuf=np.ascontiguousarray(array))

    @contextmanager
    def output(self, array: np.ndarray) -> Iterator[cl.Buffer]:
        """Yield a buffer for kernels to fill. When the block ends, the contiguous array holds the result.

        If the device has its own memory, elements that the kernels do not write are undefined.
        """
        buffer = self._share(array) if self._shares_memory else self.scratch(array.nbytes)
        yield buffer
        self._fetch(array, buffer)

    @_translated
    def _share(self, array: np.ndarray) -> cl.Buffer:
        return cl.Buffer(self._context, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, hostbuf=array)

    @_translated
    def _fetch(self, array: np.ndarray, buffer: cl.Buffer) -> None:
        if not self._shares_memory:
            cl.enqueue_copy(self._queue, array, buffer)
            return
        # The host sees a shared buffer only after mapping it. Mapping shared memory copies nothing.
        mapped, _ = cl.enqueue_map_buffer(
            self._queue, buffer, cl.map_flags.READ, 0, array.shape, array.dtype, strides=array.strides
        )
        mapped.base.release(self._queue)
