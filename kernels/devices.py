"""What OpenCL devices there are, and the choice among them. pyopencl is imported only on demand."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from dior_rt.kernels.guard import GuardedOps
from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.selftest import self_test
from dior_rt.kernels.types import Device, KernelError


def list_devices() -> list[Device]:
    """Every OpenCL device, in the platforms' order. Raises KernelError where there is no OpenCL at all."""
    prepare_caches()
    try:
        import pyopencl as cl
    except ImportError as error:
        raise KernelError(f"pyopencl cannot be loaded ({error})") from error
    try:
        handles = [device for platform in cl.get_platforms() for device in _devices(platform)]
    except cl.Error as error:
        raise KernelError(f"there is no OpenCL platform ({error})") from error
    types = {cl.device_type.GPU: "gpu", cl.device_type.CPU: "cpu", cl.device_type.ACCELERATOR: "accelerator"}
    return [
        Device(
            index,
            handle.name.strip(),
            handle.platform.name.strip(),
            next((word for bit, word in types.items() if handle.type & bit), "other"),
            handle,
        )
        for index, handle in enumerate(handles)
    ]


def prepare_caches() -> None:
    """Have PoCL and pyopencl keep what they compile in a folder that is writable and nobody else's.

    PoCL would use ~/.cache/pocl/kcache, have no device at all where that cannot be written, and, without a
    HOME, load code from /tmp/pocl, which anyone may have put there. Its last resort here is a temporary
    folder of this process; pyopencl's is to cache nothing. To be called before pyopencl is imported."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home, "pocl", "kcache")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        folder = Path(tempfile.mkdtemp(prefix="pocl-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
    os.environ.setdefault("POCL_CACHE_DIR", str(folder))


def open_ops(name: str = "auto") -> Ops:
    """The Ops of that name, see `open_device`; `reason` says why it was chosen.

    "numpy"; "opencl": the best OpenCL device; "opencl:<which>": the device of that index, or the first whose
    name contains the text; "auto": a GPU, else another OpenCL device, else NumPy. Under "auto" a device that
    cannot be opened gives way to the next, and one that fails later to NumPy; the reason says so. Raises
    KernelError where what was named cannot be had."""
    if name == "numpy":
        return NumpyOps()
    if name == "auto":
        return _choose_best()
    backend, _, which = name.partition(":")
    if backend != "opencl":
        raise KernelError(f"there are no pixel kernels called {name!r}: use auto, numpy or opencl[:<which>]")
    devices = by_preference(list_devices())
    if which:
        devices = [device for device in devices if _answers_to(device, which)]
    if not devices:
        raise KernelError(f"no OpenCL device answers to {name!r}")
    return open_device(devices[0])


def open_device(device: Device, spare: Ops | None = None) -> GuardedOps:
    """The Ops of one device. An operation is tried before its first use; where it fails, `spare` takes over.

    Raises KernelError if the device cannot be opened, or fails what every 8-bit photo needs first."""
    from dior_rt.kernels.opencl_ops import OpenCLOps

    return GuardedOps(OpenCLOps(device), spare)


def check_device(device: Device) -> None:
    """Try every operation on a device. Raises KernelError that says what is wrong with it."""
    from dior_rt.kernels.opencl_ops import OpenCLOps

    self_test(OpenCLOps(device))


def by_preference(devices: list[Device]) -> list[Device]:
    """GPUs first, then CPUs, then the rest; otherwise in the platforms' order."""
    order = {"gpu": 0, "cpu": 1}
    return sorted(devices, key=lambda device: order.get(device.type, 2))


def _choose_best() -> Ops:
    try:
        devices = by_preference(list_devices())
        problems = [] if devices else ["no OpenCL platform has a device"]
    except KernelError as error:
        devices, problems = [], [str(error)]
    ops: Ops = NumpyOps()
    for device in devices:
        try:
            tested = open_device(device, spare=ops)
        except KernelError as error:
            problems.append(str(error))
            continue
        tested.reason = "; ".join(
            [*problems, f"it is the first OpenCL {device.type} that passes its self-test"]
        )
        return tested
    ops.reason = "; ".join([*problems, "so the pixel kernels run on NumPy"])
    return ops


def _devices(platform: Any) -> list[Any]:
    """A platform's devices; one that has none says so with an error."""
    import pyopencl as cl

    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


def _answers_to(device: Device, which: str) -> bool:
    return device.index == int(which) if which.isdecimal() else which.lower() in device.name.lower()
