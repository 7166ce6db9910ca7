"""An opened OpenCL device: its programs, its buffers, how a kernel is launched. Knows nothing of pictures."""

from __future__ import annotations

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
#: How many neighbours one work item takes on a CPU.
CPU_RUN = 4096


def _translated(method: Callable[P, T]) -> Callable[P, T]:
    """The method, raising KernelError, one sentence, for what OpenCL reports."""

    @wraps(method)
    def translated(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(*args, **kwargs)
        except cl.Error as error:
            problem = str(error).partition("\n")[0]
            raise KernelError(f"the OpenCL device failed ({problem})") from error

    return translated


class Session:
    """Safe to use from several threads: each has its own kernels, and what they share is behind a lock.

    Where the device shares the host's memory, buffers are the arrays themselves and nothing is copied.
    """

    def __init__(self, device: Device) -> None:
        """Programs are built when first needed. Raises KernelError if the device cannot be opened."""
        self.name = f"opencl:{device.index} ({device.name})"
        try:
            self._context = cl.Context([device.handle])
            self._queue = cl.CommandQueue(self._context)
            #: Floats that the device handles at a time.
            self.lanes = max(1, min(16, device.handle.preferred_vector_width_float))
            self._shares_memory = bool(device.handle.host_unified_memory)
        except cl.Error as error:
            raise KernelError(f"{self.name} cannot be opened ({error})") from error
        self._run = CPU_RUN if device.type == "cpu" else 1
        self._lock, self._local = threading.Lock(), threading.local()
        self._programs: dict[tuple[str, ...], cl.Program] = {}
        self._constants: dict[int, tuple[np.ndarray, cl.Buffer]] = {}

    @_translated
    def kernel(self, name: str, **defines: object) -> cl.Kernel:
        """The kernel of that name, of the program that is built with -Dkey=value for each of `defines`.

        All sources make one program, for a build costs a quarter of a second and more sources hardly
        anything."""
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
        """A kernel keeps its arguments, so every thread has its own. To make one takes a millisecond."""
        if not hasattr(self._local, "kernels"):
            self._local.kernels = {}
        return self._local.kernels

    @_translated
    def launch(self, kernel: cl.Kernel, count: int, rows: int, *args: cl.Buffer | int | None) -> None:
        """Run the kernel over `rows` rows of `count` things and wait, so that no buffer need outlive the
        call.

        One work item takes up to `run` neighbours on a row; the kernel gets `run` as its last argument. A CPU
        wants few, long loops and work groups of one item (PoCL compiles a kernel anew for every shape of a
        group); a GPU wants many items. None is a null pointer."""
        items = -(-count // self._run), rows
        group = (1, 1) if self._run > 1 else None
        for place, arg in enumerate((*args, self._run)):
            kernel.set_arg(place, np.int32(arg) if isinstance(arg, int) else arg)
        cl.enqueue_nd_range_kernel(self._queue, kernel, items, group).wait()

    @_translated
    def constant(self, array: np.ndarray) -> cl.Buffer:
        """A copy of an array that lives as long as the session, once for each array."""
        with self._lock:
            if id(array) not in self._constants:
                flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
                self._constants[id(array)] = array, cl.Buffer(self._context, flags, hostbuf=array)
            return self._constants[id(array)][1]

    @_translated
    def scratch(self, size: int) -> cl.Buffer:
        """An uninitialised buffer of `size` bytes on the device."""
        return cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)

    @_translated
    def clear(self, buffer: cl.Buffer) -> None:
        """Set every byte to 0."""
        cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.uint8), 0, buffer.size).wait()

    @_translated
    def input(self, array: np.ndarray) -> cl.Buffer:
        """The array as the device sees it; the array itself if it is contiguous and the memory is shared."""
        share = cl.mem_flags.USE_HOST_PTR if self._shares_memory else cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self._context, cl.mem_flags.READ_ONLY | share, hostbuf=np.ascontiguousarray(array))

    @contextmanager
    def output(self, array: np.ndarray) -> Iterator[cl.Buffer]:
        """A buffer for kernels to fill; when the block ends, the contiguous array holds what they wrote.

        What they do not write is undefined where the device has its own memory.
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
        # Mapping is what makes the host see a shared buffer; where memory is really shared it copies nothing.
        mapped, _ = cl.enqueue_map_buffer(
            self._queue, buffer, cl.map_flags.READ, 0, array.shape, array.dtype, strides=array.strides
        )
        mapped.base.release(self._queue)
