"""Test the devices that can run the network and the pixel kernels here, and explain what "auto" chooses."""

from __future__ import annotations

from dataclasses import dataclass

from dior_rt.bundle import Bundle
from dior_rt.engine import open_engine
from dior_rt.errors import DiorError
from dior_rt.kernels import KernelError, check_device, list_devices, open_ops
from dior_rt.plugins import PACKAGES, is_installed
from dior_rt.providers import PROVIDERS, available, is_built_in


@dataclass(frozen=True)
class Device:
    """A device.

    name: as --device or --ops takes it. problem: why it cannot be used, or None where it passed.
    """

    name: str
    description: str
    problem: str | None = None


@dataclass(frozen=True)
class Choice:
    """The choice of "auto", and the reason."""

    name: str
    reason: str


@dataclass(frozen=True)
class Survey:
    """The devices of one kind of work, and the choice among them."""

    devices: tuple[Device, ...]
    auto: Choice


def survey_network(bundle: Bundle) -> Survey:
    """Test every provider of the installed ONNX Runtime against the bundle's own answer."""
    graph = next(iter(bundle.manifest.graphs))
    devices = []
    for name in available():
        try:
            open_engine(bundle, graph, name)
            problem = None
        except DiorError as error:
            problem = str(error)
        kind = "" if is_built_in(name) else " (plug-in)"
        devices.append(Device(name, f"ONNX Runtime, {PROVIDERS[name].ort_name}{kind}", problem))
    for name in PACKAGES:
        if is_installed(name) and name not in available():
            problem = "its package is installed and finds no hardware that it can use"
            devices.append(Device(name, f"ONNX Runtime, {PROVIDERS[name].ort_name} (plug-in)", problem))
    engine = open_engine(bundle, graph, "auto")
    return Survey(tuple(devices), Choice(engine.device, engine.reason))


def survey_ops() -> Survey:
    """Test every OpenCL device against NumPy, and list NumPy."""
    devices = []
    try:
        for device in list_devices():
            try:
                check_device(device)
                problem = None
            except KernelError as error:
                problem = str(error)
            description = f"OpenCL {device.type}, {device.name} ({device.platform})"
            devices.append(Device(f"opencl:{device.index}", description, problem))
    except KernelError as error:
        devices.append(Device("opencl", "OpenCL", str(error)))
    devices.append(Device("numpy", "NumPy, on the CPU"))
    ops = open_ops("auto")
    return Survey(tuple(devices), Choice(ops.name, ops.reason))
