"""The engine: one ONNX graph on one device, through ONNX Runtime.

A device is named as on the command line: "cpu", "cuda", "cuda:1", "openvino:GPU", or "auto". No graph ever
moves to another device in silence, and a device that computes wrong results is refused.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

from dior_rt.bundle import Bundle, Tensor
from dior_rt.errors import BundleError, DeviceError, InputError
from dior_rt.files import reason

Feeds = Mapping[str, NDArray]

SELF_TEST_TOLERANCE = 1e-3  # of the answer's largest value; float32 keeps 1e-5, TensorFloat-32 does not pass

_DTYPES = {
    "tensor(float)": "float32",
    "tensor(float16)": "float16",
    "tensor(double)": "float64",
    "tensor(int64)": "int64",
    "tensor(int32)": "int32",
    "tensor(uint8)": "uint8",
    "tensor(int8)": "int8",
    "tensor(bool)": "bool",
}
_ORT_ERRORS: tuple[type[Exception], ...] = (
    RuntimeError,
    ValueError,
    *(kind for kind in vars(ort_state).values() if isinstance(kind, type) and issubclass(kind, Exception)),
)


@dataclass(frozen=True)
class Provider:
    """An execution provider of ONNX Runtime.

    ort_name: its name there. options: what keeps it in float32. choice: the option that picks one of its
    devices, if there is one.
    """

    ort_name: str
    options: Mapping[str, str] = field(default_factory=dict)
    choice: str = "device_id"


# In the order in which "auto" tries them.
PROVIDERS = {
    "cuda": Provider("CUDAExecutionProvider", {"use_tf32": "0"}),
    "migraphx": Provider("MIGraphXExecutionProvider"),
    "dml": Provider("DmlExecutionProvider"),
    "coreml": Provider("CoreMLExecutionProvider", {"ModelFormat": "MLProgram"}, choice="MLComputeUnits"),
    "webgpu": Provider("WebGpuExecutionProvider"),
    "openvino": Provider("OpenVINOExecutionProvider", {"precision": "FP32"}, choice="device_type"),
    "cpu": Provider("CPUExecutionProvider", choice=""),
}


class Engine:
    """One graph, loaded once. Safe to use from several threads.

    inputs, outputs: the graph's tensors. device: as named. reason: why this device.
    """

    def __init__(
        self, model: Path, device: str = "cpu", threads: int | None = None, reason: str = ""
    ) -> None:
        """Load `model`. threads: CPU threads for one operation; None leaves it to ONNX Runtime.

        Raises DeviceError for a device that is not there, BundleError for a file that is no ONNX graph.
        """
        self.device = device
        self.reason = reason or f"{device} was asked for"
        self._session = _open_session(model, device, threads)
        self.inputs = tuple(map(_tensor, self._session.get_inputs()))
        self.outputs = tuple(map(_tensor, self._session.get_outputs()))
        # Only the CPU's provider promises to run one session from several threads at once.
        self._lock = contextlib.nullcontext() if device == "cpu" else threading.Lock()

    def bind(self, constants: Feeds) -> Binding:
        """Put inputs that stay the same over many runs onto the device, once."""
        return Binding(self, constants)

    def run(self, feeds: Feeds) -> dict[str, NDArray]:
        """Run the graph once: {input name: array} -> {output name: array}. Raises as `Binding.run` does."""
        return self.bind({}).run(feeds)


class Binding:
    """An engine with some of its inputs in place. Belongs to one thread."""

    def __init__(self, engine: Engine, constants: Feeds) -> None:
        self._engine = engine
        self._constants = {name: np.ascontiguousarray(array) for name, array in constants.items()}
        check_feeds(tuple(tensor for tensor in engine.inputs if tensor.name in constants), constants)
        with _translated(f"{engine.device} failed"), engine._lock:
            self._binding = engine._session.io_binding()
            self._put(self._constants)
            for output in engine.outputs:
                self._binding.bind_output(output.name)

    def run(self, feeds: Feeds) -> dict[str, NDArray]:
        """Run with the remaining inputs.

        Raises InputError where an input is missing, unknown, or of another dtype or shape than the graph's,
        and DeviceError where the device fails or computes what is no number.
        """
        engine = self._engine
        feeds = {name: np.ascontiguousarray(array) for name, array in feeds.items()}
        check_feeds(engine.inputs, {**self._constants, **feeds})
        with _translated(f"{engine.device} failed"), engine._lock:
            self._put(feeds)
            engine._session.run_with_iobinding(self._binding)
            arrays = self._binding.copy_outputs_to_cpu()
        if not all(np.isfinite(array).all() for array in arrays):
            raise DeviceError(f"{engine.device} failed: the network's output is not finite.")
        return dict(zip((output.name for output in engine.outputs), arrays, strict=True))

    def _put(self, feeds: Feeds) -> None:
        for name, array in feeds.items():
            self._binding.bind_cpu_input(name, array)


def open_engine(bundle: Bundle, graph: str, device: str = "auto", threads: int | None = None) -> Engine:
    """Load a graph of a bundle on a device, and hold it to the bundle's own answer.

    "auto" takes the first accelerator that is there and computes right, else the CPU; `engine.reason` says
    why. Raises DeviceError for a device that is not there or computes wrong results, and BundleError.
    """
    if device != "auto":
        return _open_tested(bundle, graph, device, threads)
    failures = []
    for name in available()[:-1]:
        try:
            return _open_tested(bundle, graph, name, threads, f"{name} is there and passes its self-test")
        except DeviceError as error:
            failures.append(str(error))
    reason = " ".join(failures) or "ONNX Runtime finds no accelerator here"
    return _open_tested(bundle, graph, "cpu", threads, reason)


def available() -> list[str]:
    """The devices that the installed ONNX Runtime was built for, best first; "cpu" is always the last."""
    built = ort.get_available_providers()
    return [name for name, provider in PROVIDERS.items() if provider.ort_name in built]


def check_feeds(inputs: tuple[Tensor, ...], feeds: Feeds) -> None:
    """InputError unless the arrays fit: names, dtypes, ranks, fixed sides, and sides that share a name."""
    expected = {tensor.name for tensor in inputs}
    if expected != feeds.keys():
        raise InputError(f"The network expects {sorted(expected)} and got {sorted(feeds)}.")
    sides: dict[str, int] = {}
    for tensor in inputs:
        array, known = feeds[tensor.name], dict(sides)
        fits = array.dtype == tensor.dtype and array.ndim == len(tensor.shape)
        for side, size in zip(tensor.shape, array.shape, strict=False):
            fits &= size == (side if isinstance(side, int) else sides.setdefault(side, size))
            fits &= size > 0 and size % _multiple(side) == 0
        if not fits:
            shape = [known.get(side, side) if isinstance(side, str) else side for side in tensor.shape]
            raise InputError(
                f"The network's input {tensor.name!r} expects {tensor.dtype} {_by(shape)} "
                f"and got {array.dtype} {_by(array.shape)}."
            )


def _multiple(side: int | str) -> int:
    """Of what a side must be a multiple: 4 for the side "4*rows"."""
    factor, star, _ = str(side).partition("*")
    return int(factor) if star and factor.isdecimal() else 1


def _open_tested(bundle: Bundle, graph: str, device: str, threads: int | None, reason: str = "") -> Engine:
    engine = Engine(bundle.path(graph), device, threads, reason)
    promised = bundle.manifest.graphs[graph]
    if (engine.inputs, engine.outputs) != (promised.inputs, promised.outputs):
        raise BundleError(
            f"The graph {graph!r} of {bundle.folder} has other tensors than its manifest names."
        )
    if promised.probe:
        _self_test(engine, bundle.folder / promised.probe)
    return engine


def _self_test(engine: Engine, probe: Path) -> None:
    """Hold the engine to the probe: an .npz of the graph's inputs and of the outputs they have in torch."""
    try:
        with np.load(probe, allow_pickle=False) as arrays:
            feeds = {tensor.name: arrays[tensor.name] for tensor in engine.inputs}
            wanted = {tensor.name: arrays[tensor.name] for tensor in engine.outputs}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise BundleError(f"Cannot read the self-test {probe}: {reason(error)}.") from error
    for name, got in engine.run(feeds).items():
        want = wanted[name]
        error_here = np.abs(got - want).max() / np.abs(want).max()
        if not error_here <= SELF_TEST_TOLERANCE:
            raise DeviceError(
                f"{engine.device} computes wrong results: off by {error_here:.2g} in its self-test."
            )


def _open_session(model: Path, device: str, threads: int | None) -> ort.InferenceSession:
    name, _, choice = device.partition(":")
    if name not in available() or (choice and not PROVIDERS[name].choice):
        raise DeviceError(f"There is no device {device!r} here; there is {', '.join(available())}, or auto.")
    provider = PROVIDERS[name]
    options = ort.SessionOptions()
    options.log_severity_level = 3
    if threads is not None:
        if threads < 1:
            raise InputError(f"threads must be at least 1, not {threads}.")
        options.intra_op_num_threads = threads
    if name == "dml":  # DirectML's provider demands both
        options.enable_mem_pattern = False
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    providers = [(provider.ort_name, {**provider.options, **({provider.choice: choice} if choice else {})})]
    if name != "cpu":  # it takes the operations that an accelerator lacks
        providers.append((PROVIDERS["cpu"].ort_name, {}))
    try:
        session = ort.InferenceSession(
            model,
            options,
            providers=providers,
            enable_fallback=0,
        )
    except _ORT_ERRORS as error:
        # What the CPU cannot load is no graph; an accelerator may have reasons of its own.
        kind = BundleError if name == "cpu" else DeviceError
        raise kind(f"{device} cannot load {model}: {reason(error)}.") from error
    if session.get_providers()[0] != provider.ort_name:
        raise DeviceError(f"{device} could not be started; ONNX Runtime fell back to the CPU.")
    return session


@contextlib.contextmanager
def _translated(what: str) -> Iterator[None]:
    try:
        yield
    except _ORT_ERRORS as error:
        raise DeviceError(f"{what}: {reason(error)}.") from error


def _tensor(node: ort.NodeArg) -> Tensor:
    return Tensor(node.name, _DTYPES.get(node.type, node.type), tuple(node.shape))


def _by(shape: Sequence[int | str]) -> str:
    return " x ".join(map(str, shape)) or "scalar"
