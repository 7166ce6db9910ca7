"""The devices of ONNX Runtime: their names, how to open a session on one, and the translation of its errors.

A device is named as on the command line: "cpu", "cuda", "cuda:1", "openvino:GPU". No graph ever moves to
another device without notice.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

from dior_rt.errors import BundleError, DeviceError, InputError
from dior_rt.files import reason
from dior_rt.plugins import plugin_devices

with contextlib.suppress(Exception):  # the Windows builds, which report to the operating system
    ort.disable_telemetry_events()

_ORT_ERRORS: tuple[type[Exception], ...] = (
    RuntimeError,
    ValueError,
    TypeError,
    OSError,
    *(kind for kind in vars(ort_state).values() if isinstance(kind, type) and issubclass(kind, Exception)),
)


@dataclass(frozen=True)
class Provider:
    """An execution provider of ONNX Runtime.

    ort_name: its name in ONNX Runtime. options: those that keep it in float32. choice: the option that picks
    one of its devices. accelerator: the device that "auto" tries, where the provider's default may be the
    CPU.
    """

    ort_name: str
    options: Mapping[str, str] = field(default_factory=dict)
    choice: str = "device_id"
    accelerator: str = ""


# In the order in which "auto" tries them.
PROVIDERS = {
    "cuda": Provider("CUDAExecutionProvider", {"use_tf32": "0"}),
    "migraphx": Provider("MIGraphXExecutionProvider"),
    "dml": Provider("DmlExecutionProvider"),
    "coreml": Provider("CoreMLExecutionProvider", {"ModelFormat": "MLProgram"}, "MLComputeUnits"),
    "webgpu": Provider("WebGpuExecutionProvider"),
    "openvino": Provider("OpenVINOExecutionProvider", {"precision": "FP32"}, "device_type", "GPU"),
    "cpu": Provider("CPUExecutionProvider", choice=""),
}


def available() -> list[str]:
    """Return the names of the built-in or plugged-in providers that find hardware. "cpu" is the last."""
    built = ort.get_available_providers()
    return [
        name for name, provider in PROVIDERS.items() if provider.ort_name in built or plugin_devices(name)
    ]


def accelerators() -> list[str]:
    """Return the devices that "auto" tries before the CPU, best first."""
    choices = {name: PROVIDERS[name].accelerator for name in available() if name != "cpu"}
    return [
        f"{name}:{choice}" if choice else name
        for name, choice in choices.items()
        if is_built_in(name) or plugin_devices(name, choice)
    ]


def is_built_in(name: str) -> bool:
    """Return whether the installed ONNX Runtime was built with a provider. Others may be plugged in."""
    return PROVIDERS[name].ort_name in ort.get_available_providers()


def open_session(model: Path, device: str, threads: int | None, keep: bool = True) -> ort.InferenceSession:
    """Load a graph on a device. The CPU runs the operations that the device lacks.

    threads: CPU threads for one operation; None leaves the number to ONNX Runtime. keep: whether to keep
    memory and threads for the next run, which is faster. Graphs that take turns should not keep them, because
    each would withhold them from the others.

    Raises DeviceError for a device that does not exist or cannot be started, BundleError for a file that is
    not an ONNX graph, and InputError for threads below 1.
    """
    name, _, choice = device.partition(":")
    if name not in available() or (choice and not PROVIDERS[name].choice):
        raise DeviceError(f"There is no device {device!r} here; there is {', '.join(available())}, or auto.")
    provider, cpu = PROVIDERS[name], PROVIDERS["cpu"]
    options = {**provider.options, **({provider.choice: choice} if choice else {})}
    session_options = _session_options(name, threads, keep)
    providers: dict[str, Mapping[str, str]] = {provider.ort_name: options, cpu.ort_name: {}}
    if not is_built_in(name):
        devices = plugin_devices(name, choice)
        if not devices:
            raise DeviceError(f"{name} finds no device {choice!r} here.")
        session_options.add_provider_for_devices(devices, {})
        providers = {}
    try:
        session = _start(model, providers, session_options)
    except _ORT_ERRORS as error:
        # A file that the CPU cannot load is not a graph. An accelerator may fail for other reasons.
        kind = BundleError if name == "cpu" else DeviceError
        raise kind(f"{device} cannot load {model}: {reason(error)}.") from error
    if session.get_providers()[0] != provider.ort_name:
        raise DeviceError(f"{device} could not be started here.")
    return session


@contextlib.contextmanager
def translated(device: str) -> Iterator[None]:
    """Raise ONNX Runtime's errors as DeviceError."""
    try:
        yield
    except _ORT_ERRORS as error:
        raise DeviceError(f"{device} failed: {reason(error)}.") from error


def _session_options(name: str, threads: int | None, keep: bool) -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.enable_cpu_mem_arena = keep
    if not keep:  # threads that spin for their next work occupy a core
        options.add_session_config_entry("session.force_spinning_stop", "1")
    options.log_severity_level = 3
    if threads is not None:
        if threads < 1:
            raise InputError(f"threads must be at least 1, not {threads}.")
        options.intra_op_num_threads = threads
    if name == "dml":  # DirectML's provider requires both
        options.enable_mem_pattern = False
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    return options


def _readable(model: Path) -> str | bytes:
    """Return the path as ONNX Runtime takes it: as text, or the file's content where the path is not valid
    text.
    """
    try:
        str(model).encode()
    except UnicodeEncodeError:
        return model.read_bytes()
    return str(model)


def _start(
    model: Path, providers: Mapping[str, Mapping[str, str]], options: ort.SessionOptions
) -> ort.InferenceSession:
    ort.set_default_logger_severity(
        4
    )  # failures are raised or seen by the caller, so the terminal needs no log
    try:
        return ort.InferenceSession(
            _readable(model), options, providers=list(providers.items()) or None, enable_fallback=0
        )
    finally:
        ort.set_default_logger_severity(2)
