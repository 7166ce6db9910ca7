"""Use a device in a process of its own; see `dior_rt.kernels.probe`."""

from __future__ import annotations

import contextlib

from dior_rt.kernels.devices import list_devices
from dior_rt.kernels.opencl_ops import OpenCLOps
from dior_rt.kernels.selftest import self_test
from dior_rt.kernels.types import KernelError


def try_device(index: int) -> None:
    """Run the self-test that an 8-bit picture needs on a device.

    A KernelError does no harm here, because it is raised again when the device is requested.
    """
    with contextlib.suppress(KernelError):
        self_test(OpenCLOps(list_devices()[index]))
