"""Count the floating-point operations of a step, and measure how fast its matrix products run.

Both come from a real run: ONNX Runtime reports the shapes and the time of every node.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from dior_rt.bundle import Bundle

PRODUCTS = ("MatMul", "MatMulInteger", "MatMulNBits", "Gemm")
CONVOLUTIONS = ("Conv", "ConvInteger")
TRANSPOSED = ("ConvTranspose",)
ATTENTIONS = ("Attention", "MultiHeadAttention")
#: The node types into which ONNX Runtime's optimiser turns the first three.
FUSED = ("FusedMatMul", "FusedGemm", "FusedConv", "DynamicQuantizeMatMul", "MatMulIntegerToFloat")
TRIES = 9

Shape = Sequence[int]


@dataclass(frozen=True)
class Step:
    """Everything that the cost of a step depends on.

    bundle: the folder. rows, columns: of the grid, in units of its multiple. branches: of guidance, 1 or 2.
    """

    bundle: str
    rows: int
    columns: int
    branches: int

    @property
    def name(self) -> str:
        """Return the name for tables and JSON keys."""
        return f"{self.bundle}, {self.rows} x {self.columns} x {self.branches}"


def node_flops(operation: str, inputs: Sequence[Shape], output: Shape) -> int:
    """Return 2 x (elements of the output) x (length of the sums): one multiplication and one addition each.

    Matrix products sum over the last side of their first input. A convolution sums over all sides of its
    weights except the first. A transposed convolution multiplies every input element by all sides of its
    weights except the first. Attention is two products. Nothing else is counted: other nodes are bound by
    memory and small in comparison.
    """
    if operation in PRODUCTS:
        return 2 * math.prod(output) * inputs[0][-1]
    if operation in CONVOLUTIONS:
        return 2 * math.prod(output) * math.prod(inputs[1][1:])
    if operation in TRANSPOSED:
        return 2 * math.prod(inputs[0]) * math.prod(inputs[1][1:])
    if operation in ATTENTIONS:  # queries (batch, tokens, width) by keys (batch, others, width), by values
        return 4 * math.prod(inputs[0]) * inputs[1][-2]
    return 0


def graph_flops(model: Path, feeds: Mapping[str, NDArray]) -> dict[str, int]:
    """Return the operations of one run of an ONNX graph by type of node, without fusing nodes."""
    found: dict[str, int] = defaultdict(int)
    for node in _profile(model, feeds, ort.GraphOptimizationLevel.ORT_DISABLE_ALL, 1):
        what = node["args"]
        for output in _shapes(what["output_type_shape"])[:1]:
            found[what["op_name"]] += node_flops(what["op_name"], _shapes(what["input_type_shape"]), output)
    return found


def product_rate(bundle: Bundle, step: Step) -> float:
    """Return the floating-point operations per second of the network's matrix products and convolutions.

    They are timed inside runs of the whole graph, on as many threads as ONNX Runtime uses. So they have their
    real shapes, and all weights pass through the caches between two uses. The seconds are medians of a few
    runs per node. Attention is left out, because its node does more than products.
    """
    model, feeds = bundle.path("velocity"), step_feeds(bundle, step)
    flops = sum(count for kind, count in graph_flops(model, feeds).items() if kind not in ATTENTIONS)
    seconds: dict[str, list[float]] = defaultdict(list)
    for node in _profile(model, feeds, ort.GraphOptimizationLevel.ORT_ENABLE_ALL, TRIES):
        if node["args"]["op_name"] in (*PRODUCTS, *CONVOLUTIONS, *TRANSPOSED, *FUSED):
            seconds[node["name"]].append(node["dur"] * 1e-6)
    return flops / sum(map(median, seconds.values()))


def step_of(bundle: Bundle, size: tuple[int, int], guidance: float) -> Step | None:
    """Return the step for a photo of `size` pixels. Guidance other than 0 and 1 takes two branches.

    Return None for families without a light grid. Their graphs are too large to run only for this.
    """
    grid = bundle.manifest.grid
    if grid is None:
        return None
    rows, columns = (side // grid.multiple for side in grid.shape(*size))
    return Step(str(bundle.folder), rows, columns, 1 if guidance in (0, 1) else 2)


def step_flops(bundle: Bundle, step: Step) -> int:
    """Return the number of operations of one step."""
    return sum(graph_flops(bundle.path("velocity"), step_feeds(bundle, step)).values())


def step_feeds(bundle: Bundle, step: Step) -> dict[str, NDArray]:
    """Return inputs of a step of that size. Their values change neither the count nor the time."""
    sides = {"batch": step.branches, "rows": step.rows, "columns": step.columns}
    return {
        tensor.name: np.ones([_side(side, sides) for side in tensor.shape], tensor.dtype)
        for tensor in bundle.manifest.graphs["velocity"].inputs
    }


def _profile(
    model: Path, feeds: Mapping[str, NDArray], level: ort.GraphOptimizationLevel, runs: int
) -> list[dict[str, Any]]:
    """Yield ONNX Runtime's profile of every node in every run."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = level
    options.enable_profiling = True
    with tempfile.TemporaryDirectory(prefix="dior-bench-") as folder:
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
        for _ in range(runs):
            session.run(None, dict(feeds))
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    return [event for event in events if event["name"].endswith("_kernel_time")]


def _side(side: int | str, sides: Mapping[str, int]) -> int:
    """Return the length of a side such as 3, "rows" or "4*rows"."""
    if isinstance(side, int):
        return side
    factor, _, name = side.rpartition("*")
    return int(factor or 1) * sides[name]


def _shapes(described: Sequence[Mapping[str, Any]]) -> list[Shape]:
    """Return the shapes in a profile entry such as [{"float": [2, 3]}, {"int64": []}]."""
    return [shape for tensor in described for shape in tensor.values()]
