"""A graph of this project's export in lower precision, by ONNX Runtime's own tools."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper
from onnxruntime.quantization import QuantType, quantize_dynamic
from onnxruntime.transformers.float16 import convert_float_to_float16

PRECISIONS = ("fp32", "fp16", "int8")


def lower(graph: Path, precision: str, path: Path) -> Path:
    """Write `graph` at `path`: as it is, with all of it but inputs and outputs in float16, or with its matrix
    products in int8 (weights by output channel, activations by their range in each call)."""
    if precision == "fp32":
        shutil.copyfile(graph, path)
        return path
    model = _with_weights_in_place(onnx.load(graph))
    if precision == "fp16":
        onnx.save(convert_float_to_float16(model, keep_io_types=True), path)
        return path
    logging.disable(logging.WARNING)  # advice to preprocess, which the export has done
    try:
        quantize_dynamic(
            model,
            path,
            weight_type=QuantType.QInt8,
            per_channel=True,
            op_types_to_quantize=["MatMul", "Gemm"],
        )
    finally:
        logging.disable(logging.NOTSET)
    return path


def _with_weights_in_place(model: onnx.ModelProto) -> onnx.ModelProto:
    """Weights that are stored as float16 and cast become the float32 that they are cast to."""
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes = []
    for node in model.graph.node:
        if node.op_type == "Cast" and node.input[0] in weights:
            weight = weights[node.input[0]]
            wide = numpy_helper.to_array(weight).astype(np.float32)
            weight.CopyFrom(numpy_helper.from_array(wide, node.output[0]))
        else:
            nodes.append(node)
    del model.graph.node[:], model.graph.value_info[:]
    model.graph.node.extend(nodes)
    return model
