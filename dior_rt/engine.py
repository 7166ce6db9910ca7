"""The engine: one ONNX graph on one device, tested against the bundle's own answers before it is used."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from dior_rt.bundle import Bundle, Tensor
from dior_rt.errors import BundleError, DeviceError, InputError
from dior_rt.files import reason
from dior_rt.providers import accelerators, open_session, translated

Feeds = Mapping[str, NDArray]

SELF_TEST_TOLERANCE = 3e-4  # share of a row's largest value; float32 keeps 1e-5, TensorFloat-32 does not pass

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


class Engine:
    """One graph, loaded once. Safe to use from several threads.

    inputs, outputs: the graph's tensors. device: its name. reason: why this device was chosen.
    """

    def __init__(
        self,
        model: Path,
        device: str = "cpu",
        threads: int | None = None,
        reason: str = "",
        keep: bool = True,
    ) -> None:
        """Load `model`. threads, keep: as `open_session` takes them.

        Raises DeviceError for a device that does not exist, and BundleError for a file that is not an ONNX
        graph.
        """
        self.device = device
        self.reason = reason or f"{device} was asked for"
        self._session = open_session(model, device, threads, keep)
        self._process = os.getpid()
        try:
            self.inputs = tuple(map(_tensor, self._session.get_inputs()))
            self.outputs = tuple(map(_tensor, self._session.get_outputs()))
        except UnicodeDecodeError as error:
            raise BundleError(f"Cannot use {model}: a tensor's name in it is no text.") from error
        # Only the CPU's provider promises to run one session from several threads at once.
        self._lock = contextlib.nullcontext() if device == "cpu" else threading.Lock()

    def bind(self, constants: Feeds) -> Binding:
        """Put inputs that stay the same over many runs onto the device, once."""
        return Binding(self, constants)

    def check_process(self) -> None:
        """Raise DeviceError in a fork of the process that loaded the graph, because a fork lacks its
        threads.
        """
        if os.getpid() != self._process:
            raise DeviceError(
                "This model was loaded before the process was forked, and its threads were not copied: load "
                "it in each process, or start processes by the method 'spawn'."
            )

    def run(self, feeds: Feeds) -> dict[str, NDArray]:
        """Run the graph once: {input name: array} -> {output name: array}. Raises as `Binding.run` does."""
        return self.bind({}).run(feeds)


class Binding:
    """An engine with some of its inputs in place. It belongs to one thread."""

    def __init__(self, engine: Engine, constants: Feeds) -> None:
        engine.check_process()
        self._engine = engine
        self._constants = {name: np.asarray(array, order="C") for name, array in constants.items()}
        check_feeds(tuple(tensor for tensor in engine.inputs if tensor.name in constants), constants)
        with translated(engine.device), engine._lock:
            self._binding = engine._session.io_binding()
            self._put(self._constants)
            for output in engine.outputs:
                self._binding.bind_output(output.name)

    def run(self, feeds: Feeds) -> dict[str, NDArray]:
        """Run with the remaining inputs.

        Raises InputError where an input is missing, unknown, or of another dtype or shape than the graph's,
        and DeviceError where the device fails or computes values that are not finite numbers.
        """
        engine = self._engine
        engine.check_process()
        feeds = {name: np.asarray(array, order="C") for name, array in feeds.items()}
        check_feeds(engine.inputs, {**self._constants, **feeds})
        with translated(engine.device), engine._lock:
            self._put(feeds)
            engine._session.run_with_iobinding(self._binding)
            arrays = self._binding.copy_outputs_to_cpu()
        if not all(np.isfinite(array).all() for array in arrays):
            raise DeviceError(f"{engine.device} failed: the network's output is not finite.")
        return dict(zip((output.name for output in engine.outputs), arrays, strict=True))

    def _put(self, feeds: Feeds) -> None:
        for name, array in feeds.items():
            self._binding.bind_cpu_input(name, array)


def open_engine(
    bundle: Bundle, graph: str, device: str = "auto", threads: int | None = None, *, keep: bool = True
) -> Engine:
    """Load a graph of a bundle on a device, and test it against the bundle's own answer.

    "auto" takes the first available accelerator that computes correctly, else the CPU; `engine.reason`
    explains the choice. Raises DeviceError for a device that does not exist or computes wrong results, and
    BundleError.
    """
    if device != "auto":
        return _open_tested(bundle, graph, device, threads, keep=keep)
    failures = []
    for name in accelerators():
        try:
            return _open_tested(
                bundle, graph, name, threads, f"{name} is there and passes its self-test", keep
            )
        except DeviceError as error:
            failures.append(str(error))
    reason = " ".join(failures) or "ONNX Runtime finds no accelerator here"
    return _open_tested(bundle, graph, "cpu", threads, reason, keep)


def check_feeds(inputs: tuple[Tensor, ...], feeds: Feeds) -> None:
    """Raise InputError unless the arrays fit: names, dtypes, ranks, fixed sides, and sides that share a
    name.
    """
    expected = {tensor.name for tensor in inputs}
    if expected != feeds.keys():
        raise InputError(f"The network expects {sorted(expected)} and got {sorted(feeds)}.")
    sides: dict[str, int] = {}
    for tensor in inputs:
        array, lengths = feeds[tensor.name], dict(sides)
        fits = array.dtype == tensor.dtype and array.ndim == len(tensor.shape)
        for side, size in zip(tensor.shape, array.shape, strict=False):
            fits &= size == (side if isinstance(side, int) else sides.setdefault(side, size))
            fits &= size > 0 and size % _multiple(side) == 0
        if not fits:
            shape = [lengths.get(side, side) if isinstance(side, str) else side for side in tensor.shape]
            raise InputError(
                f"The network's input {tensor.name!r} expects {tensor.dtype} {_by(shape)} "
                f"and got {array.dtype} {_by(array.shape)}."
            )


def _multiple(side: int | str) -> int:
    """Return the number that a side must be a multiple of, such as 4 for the side "4*rows"."""
    factor, star, _ = str(side).partition("*")
    return int(factor) if star and factor.isdecimal() else 1


def _open_tested(
    bundle: Bundle, graph: str, device: str, threads: int | None, reason: str = "", keep: bool = True
) -> Engine:
    engine = Engine(bundle.path(graph), device, threads, reason, keep)
    promised = bundle.manifest.graphs[graph]
    if (engine.inputs, engine.outputs) != (promised.inputs, promised.outputs):
        raise BundleError(
            f"The graph {graph!r} of {bundle.folder} has other tensors than its manifest names."
        )
    if promised.probe:
        _self_test(engine, bundle.folder / promised.probe)
    return engine


def _self_test(engine: Engine, probe: Path) -> None:
    """Test the engine with the probe: an .npz of the graph's inputs and of torch's outputs for them."""
    try:
        with np.load(probe, allow_pickle=False) as arrays:
            feeds = {tensor.name: arrays[tensor.name] for tensor in engine.inputs}
            wanted = {tensor.name: arrays[tensor.name] for tensor in engine.outputs}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise BundleError(f"Cannot read the self-test {probe}: {reason(error)}.") from error
    for name, got in engine.run(feeds).items():
        # Rows are compared one by one, because a batch's answers may differ in size by a factor of a
        # thousand.
        want, within = wanted[name], tuple(range(1, got.ndim))
        error_here = (np.abs(got - want).max(within) / np.maximum(np.abs(want).max(within), 1e-6)).max()
        if not error_here <= SELF_TEST_TOLERANCE:
            raise DeviceError(
                f"{engine.device} computes wrong results: off by {error_here:.2g} in its self-test."
            )


def _tensor(node: ort.NodeArg) -> Tensor:
    return Tensor(node.name, _DTYPES.get(node.type, node.type), tuple(node.shape))


def _by(shape: Sequence[int | str]) -> str:
    return " x ".join(map(str, shape)) or "scalar"
