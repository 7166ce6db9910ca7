"""Pixel operations in OpenCL C and in NumPy. Imported as ``dior_rt.kernels``.

ops = open_ops("auto")
grid = ops.reduce_photo(photo, (64, 64))
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dior_rt.kernels.devices import (
    check_device,
    list_devices,
    open_device,
    open_ops,
    prepare_caches,
)
from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.selftest import self_test
from dior_rt.kernels.types import Device, KernelError, Stroke, Strokes

if TYPE_CHECKING:
    from dior_rt.kernels.opencl_ops import OpenCLOps as OpenCLOps

__all__ = [
    "Device",
    "KernelError",
    "NumpyOps",
    "OpenCLOps",
    "Ops",
    "Stroke",
    "Strokes",
    "check_device",
    "list_devices",
    "open_device",
    "open_ops",
    "self_test",
]


def __getattr__(name: str) -> Any:
    # Load pyopencl only when OpenCL is used.
    if name == "OpenCLOps":
        prepare_caches()
        from dior_rt.kernels.opencl_ops import OpenCLOps

        return OpenCLOps
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
