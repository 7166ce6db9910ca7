"""Every test that asks for `ops` runs on NumPy and on every OpenCL device that is here."""

import pytest

from dior_rt.kernels import KernelError, NumpyOps, OpenCLOps, list_devices


def _devices():
    try:
        return list_devices()
    except KernelError:
        return []


DEVICES = _devices()


@pytest.fixture(scope="session", params=["numpy", *DEVICES], ids=lambda p: getattr(p, "name", p))
def ops(request):
    return NumpyOps() if request.param == "numpy" else OpenCLOps(request.param)


@pytest.fixture(scope="session", params=DEVICES, ids=lambda device: device.name)
def opencl(request):
    return OpenCLOps(request.param)
