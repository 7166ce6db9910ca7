"""List the OpenCL devices and choose among them. pyopencl is imported only when needed."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

from dior_rt.kernels.guard import GuardedOps
from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.probe import DeviceCrashError, probe
from dior_rt.kernels.selftest import self_test
from dior_rt.kernels.types import Device, KernelError

#: The process that has OpenCL's driver in it, or None.
_used_by: int | None = None


def list_devices() -> list[Device]:
    """Every OpenCL device, in the platforms' order. Raises KernelError where there is no OpenCL at all."""
    global _used_by
    if _used_by not in (None, os.getpid()):
        raise KernelError(
            "OpenCL was used before the process was forked, and its driver's threads were not copied: start "
            "processes by the method 'spawn'"
        )
    prepare_caches()
    # An older pyopencl beside a newer pytools says so on every import; nobody here can act on it.
    warnings.filterwarnings("ignore", message="pytools.persistent_dict")
    try:
        import pyopencl as cl
    except ModuleNotFoundError as error:
        raise KernelError("OpenCL is not installed (pip install 'dior-rt[opencl]')") from error
    except ImportError as error:
        raise KernelError(f"pyopencl cannot be loaded ({error})") from error
    _used_by = os.getpid()
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
    """Make PoCL and pyopencl keep compiled kernels in a writable folder that belongs to this user.

    PoCL would use ~/.cache/pocl/kcache, have no device at all where that cannot be written, and, without a
    HOME, load code from /tmp/pocl, which anyone may have put there. The folder is this program's own, so that
    it may be emptied where a file in it crashes the driver. The last resort is a temporary folder of this
    process; pyopencl's is to cache nothing. To be called before pyopencl is imported. Raises KernelError
    where nothing at all can be written."""
    if "POCL_CACHE_DIR" in os.environ:
        return
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home, "dior-rt", "pocl")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        try:
            folder = Path(tempfile.mkdtemp(prefix="pocl-"))
        except OSError as error:
            raise KernelError("there is no folder to write compiled OpenCL kernels to") from error
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
    os.environ["POCL_CACHE_DIR"] = str(folder)


def open_ops(name: str = "auto") -> Ops:
    """Return the Ops of that name. Its `reason` says why it was chosen.

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
        raise KernelError(f"there is no OpenCL device {name!r}; `dior-rt devices` lists them")
    return open_device(devices[0])


def open_device(device: Device, spare: Ops | None = None) -> GuardedOps:
    """The Ops of a device. An operation is tried before its first use; where it fails, `spare` takes over.

    Raises KernelError if the device cannot be opened, or fails what every 8-bit photo needs first."""
    probe(device)
    from dior_rt.kernels.opencl_ops import OpenCLOps

    return GuardedOps(OpenCLOps(device), spare)


def check_device(device: Device) -> None:
    """Try every operation on a device. Raises KernelError that says what is wrong with it."""
    probe(device)
    from dior_rt.kernels.opencl_ops import OpenCLOps

    self_test(OpenCLOps(device))


def by_preference(devices: list[Device]) -> list[Device]:
    """Sort GPUs first, then CPUs, then the rest, each in the order of the platforms."""
    order = {"gpu": 0, "cpu": 1}
    return sorted(devices, key=lambda device: order.get(device.type, 2))


def _choose_best() -> Ops:
    ops: Ops = NumpyOps()
    try:
        devices = by_preference(list_devices())
        problems = [] if devices else ["no OpenCL platform has a device"]
    except KernelError as error:
        devices, problems = [], [str(error)]
    for device in devices:
        try:
            tested = open_device(device, spare=ops)
        except DeviceCrashError as error:
            problems.append(str(error))
            ops.notice = f"The pixel kernels run on NumPy: {error}."
            continue
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
    """Return a platform's devices. A platform without devices raises an error, so return none then."""
    import pyopencl as cl

    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


def _answers_to(device: Device, which: str) -> bool:
    return device.index == int(which) if which.isdecimal() else which.lower() in device.name.lower()
