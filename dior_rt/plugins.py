"""Execution providers in separate packages that plug into ONNX Runtime (from 1.24.4 on)."""

from __future__ import annotations

import threading
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import onnxruntime as ort

#: The package of each provider, by the provider's name on the command line.
PACKAGES = {"webgpu": "onnxruntime_ep_webgpu", "openvino": "onnxruntime_ep_openvino"}

_lock = threading.Lock()


def plugin_devices(name: str, choice: str = "") -> list[Any]:
    """Return ONNX Runtime's devices of a plug-in.

    choice: "CPU", "GPU" or "NPU", or the number of one of them.

    The result is empty where the package is not installed, does not fit this ONNX Runtime, or finds no such
    hardware.
    """
    devices = _registered(name)
    if choice.isdecimal():
        return devices[int(choice) : int(choice) + 1]
    return [device for device in devices if not choice or device.device.type.name == choice.upper()]


def is_installed(name: str) -> bool:
    """Return whether the package of a plug-in is installed, whatever hardware it finds."""
    return name in PACKAGES and find_spec(PACKAGES[name]) is not None


def _registered(name: str) -> list[Any]:
    with _lock:
        return _register(name)


@cache
def _register(name: str) -> list[Any]:
    if not is_installed(name) or not hasattr(ort, "register_execution_provider_library"):
        return []
    package = PACKAGES[name]
    try:
        plugin = import_module(package)
        ort.register_execution_provider_library(package, plugin.get_library_path())
        return [device for device in ort.get_ep_devices() if device.ep_name == plugin.get_ep_name()]
    except Exception:  # a library that cannot be loaded here counts as missing
        return []
