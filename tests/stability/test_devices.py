"""Self-tests: a device whose results are finite but wrong is refused.

The wrong devices are real: ONNX Runtime runs a graph with one fault, and PoCL runs a kernel with a fault in
its source or its macros. Each is compared with the CPU: with the bundle's probe, or with NumPy.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import onnx
import precisions
import pytest
from onnx import helper, numpy_helper

from dior_rt.bundle import Bundle, default_bundle, read_bundle, write_bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import DeviceError
from dior_rt.kernels import KernelError, OpenCLOps, check_device, list_devices, self_test, session
from dior_rt.kernels import opencl_ops as opencl_module
from dior_rt.providers import available


def _opencl() -> list:
    """The devices that pass their self-test: only these can show that a fault is found."""
    try:
        return [device for device in list_devices() if _works(device)]
    except KernelError:
        return []


def _works(device) -> bool:
    try:
        check_device(device)
    except KernelError:
        return False
    return True


OPENCL = _opencl()
needs_opencl = pytest.mark.skipif(not OPENCL, reason="there is no OpenCL device that works")


# Networks


def rescale_output(model: onnx.ModelProto, condition: str, bound: float, factor: float) -> None:
    """velocity *= factor where sigma is (condition: Less or Greater) the bound; other rows stay right."""
    _take_output(model)
    constants = {"bound": np.float32(bound), "factor": np.float32(factor), "one": np.float32(1)}
    model.graph.initializer.extend(numpy_helper.from_array(v, k) for k, v in constants.items())
    model.graph.initializer.append(numpy_helper.from_array(np.array([-1, 1, 1, 1]), "rows"))
    model.graph.node.extend(
        [
            helper.make_node(condition, ["sigma", "bound"], ["wrong"]),
            helper.make_node("Where", ["wrong", "factor", "one"], ["factors"]),
            helper.make_node("Reshape", ["factors", "rows"], ["factor_rows"]),
            helper.make_node("Mul", ["right", "factor_rows"], ["velocity"]),
        ]
    )


def forget(model: onnx.ModelProto, name: str) -> None:
    """The graph sees nothing of an input."""
    for node in model.graph.node:
        for place, given in enumerate(node.input):
            if given == name:
                node.input[place] = f"{name}.forgotten"
    kind = np.int64 if name == "mode" else np.float32
    model.graph.initializer.append(numpy_helper.from_array(np.array(0, kind), "nothing"))
    model.graph.node.insert(0, helper.make_node("Mul", [name, "nothing"], [f"{name}.forgotten"]))


def _take_output(model: onnx.ModelProto) -> None:
    for node in model.graph.node:
        for place, made in enumerate(node.output):
            if made == "velocity":
                node.output[place] = "right"


def with_graph(bundle: Bundle, name: str, graph: Path, folder: Path) -> Bundle:
    """The bundle with another file for one of its graphs."""
    files = {file: bundle.folder / file for file in bundle.manifest.files}
    return write_bundle(folder, bundle.manifest, {**files, bundle.manifest.graphs[name].file: graph})


FAULTS = {
    "1 % too much at every sigma": lambda model: rescale_output(model, "Greater", -1.0, 1.01),
    "nothing at all next to noise": lambda model: rescale_output(model, "Greater", 0.95, 0.0),
    "10 % too little in the middle": lambda model: rescale_output(model, "Greater", 0.3, 0.9),
    "half next to the image": lambda model: rescale_output(model, "Less", 0.01, 0.5),
    "strokes unseen": lambda model: forget(model, "mask"),
    "photo unseen": lambda model: forget(model, "photo"),
    "tokens unseen": lambda model: forget(model, "tokens"),
    "mode unseen": lambda model: forget(model, "mode"),
}


@pytest.mark.parametrize("device", available())
@pytest.mark.parametrize("fault", FAULTS)
def test_a_provider_that_computes_another_function_is_refused(hold, tmp_path, fault, device):
    shipped = read_bundle(default_bundle())
    name = "encode" if fault in ("strokes unseen", "photo unseen") else "velocity"
    model = onnx.load(shipped.path(name))
    FAULTS[fault](model)
    onnx.save(model, tmp_path / "model.onnx")
    with np.load(shipped.folder / shipped.manifest.graphs[name].probe) as probe:
        feeds = {tensor.name: probe[tensor.name] for tensor in Engine(tmp_path / "model.onnx").inputs}
    answers = Engine(tmp_path / "model.onnx").run(feeds).values()
    assert all(np.isfinite(answer).all() for answer in answers)
    wrong = with_graph(shipped, name, tmp_path / "model.onnx", tmp_path / "wrong")
    with pytest.raises(DeviceError, match="wrong results"):
        open_engine(wrong, name, device)
    hold(f"network: {fault}", device, 0, 0, 0, shown="refused")


def test_a_graph_in_int8_does_not_pass_for_float32(hold, tmp_path):
    """The int8 graph stands for a provider that lowers precision by itself."""
    shipped = read_bundle(default_bundle())
    graph = precisions.lower(shipped.path("velocity"), "int8", tmp_path / "model.onnx")
    lowered = with_graph(shipped, "velocity", graph, tmp_path / "lowered")
    with pytest.raises(DeviceError, match="wrong results"):
        open_engine(lowered, "velocity", "cpu")
    hold("network: int8 for float32", "cpu", 0, 0, 0, shown="refused")


# Kernels

MUTATIONS = {
    "decode": ("curve.cl", "linear[i] = DECODE(picture[i])", "linear[i] = 1.0001f * DECODE(picture[i])"),
    "encode": ("curve.cl", "+ as_int(x)) >> SHIFT)", "+ as_int(x) + 40) >> SHIFT)"),
    "a cell's last pixel": ("reduce.cl", "x == span.last ? span.tail : 1.0f", "1.0f"),
    "a mask's weight": ("reduce.cl", "return weight * (float4)", "return (float4)"),
    "the spline": ("transfer.cl", "0.75f - d * d", "0.74f - d * d"),
    "full lanes only": (
        "transfer.cl",
        "for (int k = at; k < at + LANES; ++k) relight_amid(from + 3 * k",
        "for (int k = at; k < at + LANES; ++k) relight_amid(from + 3 * at",
    ),
    "a narrow cell's light": ("transfer.cl", "t += weight * near[2 * width]", "t += weight * near[width]"),
    "a soft edge": ("draw.cl", "3.0f - 2.0f * t", "3.0f - 1.9f * t"),
    "a cell of the lattice": ("sparsify.cl", "vstore3(mean,", "vstore3(1.001f * mean,"),
}


@pytest.fixture
def sources(tmp_path, monkeypatch) -> Path:
    """A copy of the kernels' sources, which devices are opened with."""
    for source in session.SOURCES:
        shutil.copy(session.FOLDER / source, tmp_path)
    monkeypatch.setattr(session, "FOLDER", tmp_path)
    return tmp_path


@needs_opencl
@pytest.mark.parametrize("fault", MUTATIONS)
def test_a_device_that_runs_another_kernel_is_refused(hold, sources, fault):
    name, right, wrong = MUTATIONS[fault]
    text = (sources / name).read_text("utf-8")
    assert text.count(right) == 1
    (sources / name).write_text(text.replace(right, wrong), "utf-8")
    with pytest.raises(KernelError, match="failed its self-test"):
        check_device(OPENCL[0])
    hold(f"kernel: {fault}", "opencl:0", 0, 0, 0, shown="refused")


@needs_opencl
def test_a_device_with_another_constant_is_refused(hold, monkeypatch):
    monkeypatch.setattr(opencl_module, "EPSILON", 0.021)
    with pytest.raises(KernelError, match="failed its self-test of transfer"):
        check_device(OPENCL[0])
    hold("kernel: another constant e", "opencl:0", 0, 0, 0, shown="refused")


@needs_opencl
def test_a_compiler_that_takes_liberties_is_refused(hold, sources):
    """Unsafe mathematics folds away the sum that rounds an exponent: only floats have powers."""
    for source in sources.iterdir():
        text = source.read_text("utf-8")
        source.write_text(text.replace("(y + 12582912.0f) - 12582912.0f", "y"), "utf-8")
    with pytest.raises(KernelError, match="failed its self-test"):
        self_test(OpenCLOps(OPENCL[0]), (np.float32,))
    hold("kernel: floats rounded by a compiler's liberties", "opencl:0", 0, 0, 0, shown="refused")
