"""The first use of an OpenCL device, in a process of its own, for a driver that crashes takes it along.

PoCL does where its cache's disk is full or a file in the cache is damaged. A device that passed here is not
asked again until its driver or its cache changes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from dior_rt.kernels.types import Device, KernelError

#: Bytes that the cache's disk must have left, and a file may have: more than any kernel takes.
ROOM = 64 << 20
SECONDS = 120
_CODE = "import sys; from dior_rt.kernels.trial import try_device; try_device(int(sys.argv[1]))"
_INSIDE = "DIOR_RT_PROBE"


class DeviceCrashError(KernelError):
    """A device whose driver ends the process that uses it."""


def probe(device: Device) -> None:
    """Raise KernelError where a device cannot be used without danger; what crashes it is cleared once."""
    # The driver of a GPU compiles elsewhere, and keeps no such files.
    if device.type != "cpu" or _INSIDE in os.environ:
        return
    folder = Path(os.environ["POCL_CACHE_DIR"])
    _check_room(device, folder)
    stamp = folder.with_name(f"{folder.name}-passed.json")
    mark = _mark(device, folder)
    if _read(stamp) == mark:
        return
    for attempt in range(2):
        code = _try_elsewhere(device)
        if code == 0:
            with contextlib.suppress(OSError):
                stamp.write_text(json.dumps(_mark(device, folder)))
            return
        if attempt == 0 and folder.parent.name == "dior-rt":  # never another program's
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    raise DeviceCrashError(f"opencl:{device.index} ({device.name}) ends the process that uses it ({how})")


def _try_elsewhere(device: Device) -> int:
    """The exit code of a process that uses the device; 0 where this Python cannot start one."""
    root = Path(str(sys.modules["dior_rt"].__file__)).resolve().parents[1]
    environment = {**os.environ, _INSIDE: "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), environment.get("PYTHONPATH")]))
    try:
        return subprocess.run(
            [sys.executable, "-c", _CODE, str(device.index)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=SECONDS,
            check=False,
        ).returncode
    except subprocess.TimeoutExpired:
        return -9
    except OSError:
        return 0


def _check_room(device: Device, folder: Path) -> None:
    free = shutil.disk_usage(folder).free if folder.exists() else ROOM
    with contextlib.suppress(ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        free = min(free, ROOM if limit == resource.RLIM_INFINITY else limit)
    if free < ROOM:
        raise KernelError(
            f"opencl:{device.index} ({device.name}) needs {ROOM >> 20} MB in {folder} to compile its kernels "
            f"and has {free >> 20}"
        )


def _mark(device: Device, folder: Path) -> str:
    """A hash of what decides whether the device crashes: the driver, and the files in its cache."""
    lines = [device.name, device.platform, str(getattr(device.handle, "driver_version", ""))]
    for path in sorted(folder.rglob("*")) if folder.exists() else []:
        with contextlib.suppress(OSError):
            found = path.stat()
            if path.is_file():
                lines.append(f"{path.relative_to(folder)} {found.st_size} {found.st_mtime_ns}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _read(stamp: Path) -> object:
    with contextlib.suppress(OSError, ValueError):
        return json.loads(stamp.read_text())
    return None
