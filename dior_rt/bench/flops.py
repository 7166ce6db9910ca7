"""How many floating-point operations a step of the network is, counted from the shapes of a real run."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from dior_rt.bundle import Bundle

PRODUCTS = ("MatMul", "MatMulInteger", "MatMulNBits", "Gemm")
CONVOLUTIONS = ("Conv", "ConvInteger")

Shape = Sequence[int]


def node_flops(operation: str, inputs: Sequence[Shape], output: Shape) -> int:
    """2 x (elements of the output) x (length of the sums): a multiplication and an addition each.

    Matrix products sum over the last side of their first input. A convolution sums over all sides of its
    weights but the first. Everything else is not counted: it is bound by memory, and small beside these.
    """
    if operation in PRODUCTS:
        return 2 * math.prod(output) * inputs[0][-1]
    if operation in CONVOLUTIONS:
        return 2 * math.prod(output) * math.prod(inputs[1][1:])
    return 0


def graph_flops(model: Path, feeds: Mapping[str, NDArray]) -> int:
    """The operations of one run of an ONNX graph, its nodes as they stand in the file, not fused."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.enable_profiling = True
    with tempfile.TemporaryDirectory(prefix="dior-bench-") as folder:
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
        session.run(None, dict(feeds))
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    runs = [event["args"] for event in events if event["name"].endswith("_kernel_time")]
    return sum(
        node_flops(run["op_name"], _shapes(run["input_type_shape"]), output)
        for run in runs
        for output in _shapes(run["output_type_shape"])[:1]
    )


def step_flops(bundle: Bundle, size: tuple[int, int], guidance: float) -> int | None:
    """The operations of one step for a photo of `size` pixels; guidance other than 0 and 1 doubles them.

    None for families without a light grid, whose graphs are too large to be run for this alone.
    """
    grid = bundle.manifest.grid
    if grid is None:
        return None
    branches = 1 if guidance in (0, 1) else 2
    rows, columns = (side // grid.multiple for side in grid.shape(*size))
    sides = {"batch": branches, "rows": rows, "columns": columns}
    feeds = {
        tensor.name: np.ones([_side(side, sides) for side in tensor.shape], tensor.dtype)
        for tensor in bundle.manifest.graphs["velocity"].inputs  # values do not change the count
    }
    return graph_flops(bundle.path("velocity"), feeds)


def _side(side: int | str, known: Mapping[str, int]) -> int:
    """The length of a side such as 3, "rows" or "4*rows"."""
    if isinstance(side, int):
        return side
    factor, _, name = side.rpartition("*")
    return int(factor or 1) * known[name]


def _shapes(described: Sequence[Mapping[str, Any]]) -> list[Shape]:
    """Of [{"float": [2, 3]}, {"int64": []}]."""
    return [shape for tensor in described for shape in tensor.values()]
