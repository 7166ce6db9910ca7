"""What several parts are tested with: every way to compute the pixel kernels, and the model that ships, on a
smaller grid and with few steps.

Every test that asks for `ops` runs on NumPy and on every OpenCL device that is here.
"""

import dataclasses
import shutil
from pathlib import Path

import pytest

from dior_rt.bundle import default_bundle, read_bundle, write_bundle
from dior_rt.grid import GridRule
from dior_rt.kernels import Device, KernelError, NumpyOps, Ops, check_device, list_devices


def _devices() -> list[Device]:
    try:
        return [device for device in list_devices() if _works(device)]
    except KernelError:
        return []


def _works(device: Device) -> bool:
    """Whether a driver can compile for its own device; PoCL of 2022 cannot for every CPU of today."""
    try:
        check_device(device)
    except KernelError:
        return False
    return True


DEVICES = _devices()


@pytest.fixture(scope="session", params=["numpy", *DEVICES], ids=lambda p: getattr(p, "name", p))
def ops(request: pytest.FixtureRequest) -> Ops:
    return NumpyOps() if request.param == "numpy" else _opencl(request.param)


@pytest.fixture(scope="session", params=DEVICES, ids=lambda device: device.name)
def opencl(request: pytest.FixtureRequest) -> Ops:
    return _opencl(request.param)


def _opencl(device: Device) -> Ops:
    from dior_rt.kernels import OpenCLOps  # the extra "opencl" may not be installed

    return OpenCLOps(device)


@pytest.fixture(scope="session")
def mini_bundle(tmp_path_factory) -> Path:
    """The folder of a quick bundle with the weights that ship; not to be changed."""
    folder = tmp_path_factory.mktemp("bundles")
    shutil.copytree(default_bundle(), folder / "shipped")
    shipped = read_bundle(folder / "shipped").manifest
    grid = dataclasses.replace(GridRule(cells=1024), multiple=shipped.grid.multiple)
    quick = dataclasses.replace(shipped, name="small", grid=grid, steps=4, guidance=2.0, noise_scale=1.0)
    write_bundle(folder / "small", quick, {name: folder / "shipped" / name for name in shipped.files})
    return folder / "small"


@pytest.fixture
def another_precision():
    """accelerate holds a process to its first precision; it forgets it here as in its own tests."""
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    yield
    AcceleratorState._reset_state(reset_partial_state=True)
