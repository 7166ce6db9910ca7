"""Write one ONNX graph, operation by operation, streaming its weights to a file beside it.

Graphs are built by hand and not traced. So no weight has to exist while its graph is built, and the fused
operations of ONNX Runtime (attention without the full matrix of scores, rotary embedding, block-wise int4)
and the casts of mixed precision can be placed deliberately.

Activations are float32 (tokens, width) between operations, in every precision. Only `linear` and `attention`
compute in lower precision. Each first divides the values by the largest of them, so that nothing can
overflow:

    fp32   y = x W + b
    fp16   y = s (fp16(x / s) fp16(W)) + b            s = the row's largest |x|
    int8   y = s t (uint8(127 x / s) int8(W / t)) + b t = the output channel's largest |W| / 63 / 127
    int4   y = x Q + b                                Q = int4 in blocks of 32 inputs (MatMulNBits)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from dior_rt.bundle import Graph, Tensor

Precision = Literal["fp32", "fp16", "int8", "int4"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
OPSET = 20
CONTRIB = "com.microsoft"
ALIGNMENT = 4096  # the page size, so that weights can be mapped into memory
INLINE_BYTES = 1024
BLOCK = 32  # how many int4 weights share one scale
TINY = 1e-20  # replaces the largest value of a row of zeros
ZERO = 128  # zero point of unsigned 8-bit activations, which processors multiply fastest
# Weights keep 7 of their 8 bits: x86 without VNNI adds two products in 16 bits, and 2 * 255 * 63 fits there.
WEIGHT_LEVELS = 63
ONNX_TYPES = {"float32": TensorProto.FLOAT, "int64": TensorProto.INT64}

Array = NDArray[Any]


class GraphWriter:
    """A graph under construction. Its methods return the names of values.

    Use it as a context manager, which closes the file of weights. `finish` writes the graph.
    """

    def __init__(self, path: Path, precision: Precision = "fp32") -> None:
        """Write weights to `path` with the suffix .data."""
        self.path, self.precision = path, precision
        self._nodes: list[onnx.NodeProto] = []
        self._weights: list[TensorProto] = []
        self._inputs: list[Tensor] = []
        self._outputs: list[Tensor] = []
        self._data: BinaryIO | None = None
        self._count = 0

    def __enter__(self) -> GraphWriter:
        return self

    def __exit__(self, *_: object) -> None:
        if self._data:
            self._data.close()

    @property
    def data_path(self) -> Path:
        return self.path.with_suffix(".data")

    def input(self, name: str, *shape: int | str, dtype: str = "float32") -> str:
        self._inputs.append(Tensor(name, dtype, shape))
        return name

    def output(self, name: str, value: str, *shape: int | str) -> None:
        self._nodes.append(helper.make_node("Identity", [value], [name]))
        self._outputs.append(Tensor(name, "float32", shape))

    def op(self, kind: str, *inputs: str, domain: str = "", **attributes: Any) -> str:
        """Append an operation with one output. "" omits an optional input, as in ONNX."""
        return self.ops(kind, 1, *inputs, domain=domain, **attributes)[0]

    def ops(self, kind: str, outputs: int, *inputs: str, domain: str = "", **attributes: Any) -> list[str]:
        """Append an operation with several outputs."""
        names = [self._name(kind) for _ in range(outputs)]
        self._nodes.append(helper.make_node(kind, list(inputs), names, domain=domain, **attributes))
        return names

    def constant(self, value: Array | np.generic) -> str:
        """Add a constant tensor. Large ones go to the file of weights."""
        value = np.ascontiguousarray(value)
        proto = TensorProto(
            name=self._name("constant"),
            dims=value.shape,
            data_type=helper.np_dtype_to_tensor_dtype(value.dtype),
        )
        if value.nbytes <= INLINE_BYTES:
            proto.raw_data = value.tobytes()
        else:
            self._store(proto, value)
        self._weights.append(proto)
        return proto.name

    def scalar(self, value: float) -> str:
        return self.constant(np.float32(value))

    def ints(self, *values: int) -> str:
        return self.constant(np.array(values, np.int64))

    def finish(self, name: str) -> Graph:
        """Write the graph. Return its description, with the file name alone."""
        graph = helper.make_graph(
            self._nodes,
            name,
            [_value_info(tensor) for tensor in self._inputs],
            [_value_info(tensor) for tensor in self._outputs],
            self._weights,
        )
        opsets = [helper.make_opsetid("", OPSET), helper.make_opsetid(CONTRIB, 1)]
        # IR 10 is the newest that ONNX Runtime 1.20 reads.
        model = helper.make_model(graph, opset_imports=opsets, ir_version=10, producer_name="dior-rt")
        self.path.write_bytes(model.SerializeToString())
        onnx.checker.check_model(str(self.path))
        return Graph(self.path.name, tuple(self._inputs), tuple(self._outputs))

    def linear(self, x: str, weight: Array, bias: Array | None, precision: Precision | None = None) -> str:
        """Append y = x W^T + b for x (rows, in) and a float32 weight (out, in). precision: None is the
        graph's."""
        precision = precision or self.precision
        if precision == "fp32":
            inputs = [x, self.constant(weight), *([] if bias is None else [self.constant(bias)])]
            return self.op("Gemm", *inputs, transB=1)
        y = {"fp16": self._linear_fp16, "int8": self._linear_int8, "int4": self._linear_int4}[precision](
            x, weight
        )
        return y if bias is None else self.op("Add", y, self.constant(bias))

    def layer_norm(self, x: str, width: int, eps: float) -> str:
        """Append (x - mean) / sqrt(variance + eps) over the last axis, without scale and shift."""
        return self.op("LayerNormalization", x, self.constant(np.ones(width, np.float32)), epsilon=eps)

    def rms_norm(self, x: str, scale: Array, eps: float) -> str:
        """Append x / sqrt(mean(x^2) + eps) * scale over the last axis."""
        mean = self.op("ReduceMean", self.op("Mul", x, x), self.ints(-1), keepdims=1)
        root = self.op("Sqrt", self.op("Add", mean, self.scalar(eps)))
        return self.op("Mul", self.op("Div", x, root), self.constant(scale))

    def head_norm(self, x: str, heads: int, scale: Array, eps: float) -> str:
        """Append `rms_norm` of each head of x (tokens, heads * head width)."""
        split = self.op("Reshape", x, self.ints(0, heads, -1))
        return self.op("Reshape", self.rms_norm(split, scale, eps), self.ints(0, -1))

    def rotate(self, x: str, cos: str, sin: str, *, interleaved: bool) -> str:
        """Append the rotary embedding of every head of x (tokens, width) by angles (tokens, head width / 2).

        interleaved: rotate the neighbours (0, 1), (2, 3) ..., instead of (0, d/2), (1, d/2 + 1) ...
        """
        rows = self.op("Unsqueeze", x, self.ints(0))
        turned = self.op(
            "RotaryEmbedding", rows, self.ints(0), cos, sin, domain=CONTRIB, interleaved=int(interleaved)
        )
        return self.op("Squeeze", turned, self.ints(0))

    def attention(self, q: str, k: str, v: str, heads: int, *, bias: str = "", causal: bool = False) -> str:
        """Append softmax(q k^T / sqrt(head width) + bias) v per head; all are (tokens, heads * head width).

        bias: (1, 1, tokens, tokens), or "" for none.
        """
        scale = ""
        if self.precision == "fp16":
            q, k = (self.op("Cast", value, to=TensorProto.FLOAT16) for value in (q, k))
            largest = self.op("ReduceMax", self.op("Abs", v), keepdims=0)
            scale = self.op("Max", largest, self.scalar(TINY))
            v = self.op("Cast", self.op("Div", v, scale), to=TensorProto.FLOAT16)
            bias = bias and self.op("Cast", bias, to=TensorProto.FLOAT16)
        rows = [self.op("Unsqueeze", value, self.ints(0)) for value in (q, k, v)]
        optional = ["", "", bias] if bias else []
        mixed = self.op(
            "MultiHeadAttention",
            *rows,
            *optional,
            domain=CONTRIB,
            num_heads=heads,
            unidirectional=int(causal),
        )
        mixed = self.op("Squeeze", mixed, self.ints(0))
        if not scale:
            return mixed
        return self.op("Mul", self.op("Cast", mixed, to=TensorProto.FLOAT), scale)

    def _linear_fp16(self, x: str, weight: Array) -> str:
        half, scale = self._by_largest(x)
        half = self.op("Cast", half, to=TensorProto.FLOAT16)
        y = self.op("MatMul", half, self.constant(weight.T.astype(np.float16)))
        return self.op("Mul", self.op("Cast", y, to=TensorProto.FLOAT), scale)

    def _linear_int8(self, x: str, weight: Array) -> str:
        unit, scale = self._by_largest(x)
        rounded = self.op("Round", self.op("Mul", unit, self.scalar(127)))
        levels = self.op("Cast", self.op("Add", rounded, self.scalar(ZERO)), to=TensorProto.UINT8)
        step = np.maximum(np.abs(weight).max(1, keepdims=True), TINY) / WEIGHT_LEVELS
        quantized = self.constant(np.rint(weight / step).astype(np.int8).T)
        y = self.op("MatMulInteger", levels, quantized, self.constant(np.uint8(ZERO)))
        y = self.op("Cast", y, to=TensorProto.FLOAT)
        y = self.op("Mul", y, self.constant((step[:, 0] / 127).astype(np.float32)))
        return self.op("Mul", y, scale)

    def _linear_int4(self, x: str, weight: Array) -> str:
        packed, scales = quantize_int4(weight)
        return self.op(
            "MatMulNBits",
            x,
            self.constant(packed),
            self.constant(scales),
            domain=CONTRIB,
            K=weight.shape[1],
            N=weight.shape[0],
            bits=4,
            block_size=BLOCK,
            accuracy_level=1,
        )

    def _by_largest(self, x: str) -> tuple[str, str]:
        """Append x with every row divided by its largest |value|. Also returns those values (rows, 1)."""
        largest = self.op("ReduceMax", self.op("Abs", x), self.ints(-1), keepdims=1)
        scale = self.op("Max", largest, self.scalar(TINY))
        return self.op("Div", x, scale), scale

    def _store(self, proto: TensorProto, value: Array) -> None:
        if self._data is None:
            self._data = self.data_path.open("wb")
        offset = -(-self._data.tell() // ALIGNMENT) * ALIGNMENT
        self._data.seek(offset)
        value.tofile(self._data)
        proto.data_location = TensorProto.EXTERNAL
        for key, item in (("location", self.data_path.name), ("offset", offset), ("length", value.nbytes)):
            proto.external_data.add(key=key, value=str(item))

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{kind}_{self._count}"


def quantize_int4(weight: Array) -> tuple[Array, Array]:
    """Quantise to symmetric int4 in blocks of 32 inputs, in the layout of MatMulNBits.

    weight: float32 (out, in). Returns uint8 (out, blocks, 16) with two values per byte, the lower half first,
    each with an offset of 8, and float32 scales (out * blocks,). The value of largest magnitude in a block is
    exact.
    """
    rows, columns = weight.shape
    blocks = -(-columns // BLOCK)
    padded = np.zeros((rows, blocks * BLOCK), np.float32)
    padded[:, :columns] = weight
    padded = padded.reshape(rows, blocks, BLOCK)
    extreme = np.take_along_axis(padded, np.abs(padded).argmax(-1, keepdims=True), -1)
    scale = extreme / -8
    steps = np.divide(padded, scale, out=np.zeros_like(padded), where=scale != 0)
    levels = np.clip(np.rint(steps) + 8, 0, 15).astype(np.uint8)
    return levels[..., ::2] | levels[..., 1::2] << 4, scale.reshape(-1)


def _value_info(tensor: Tensor) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(tensor.name, ONNX_TYPES[tensor.dtype], _dims(tensor.shape))


def _dims(shape: Sequence[int | str]) -> list[int | str]:
    return list(shape)
