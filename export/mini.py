"""Export mini: turn the torch network into two ONNX graphs with compact weights, and compare them with torch.

"encode" computes the features that do not depend on the flow time; "velocity" runs at every step.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import onnx
import onnx_ir
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx_ir.passes.common import ClearMetadataAndDocStringPass
from onnxruntime.quantization import QuantType, quantize_dynamic
from torch.export import Dim

from dior_rt.bundle import Bundle, Graph, Manifest, check_target, write_bundle
from dior_rt.engine import Engine, Feeds
from dior_rt.errors import InputError
from dior_rt.export.check import (
    Bars,
    ExportError,
    check_evaluations,
    check_sampling,
    evaluate,
    random_feeds,
    relative_error,
)
from dior_rt.export.fused import OPSET, TRANSLATIONS, encode_fused, fused
from dior_rt.export.lora import merge_lora
from dior_rt.families import mini
from dior_rt.files import reason
from dior_rt.flow.sampler import Array
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.grid import GridRule
from dior_rt.training.network import LORA, WEIGHTS, Features, Mini, load_network

Weights = Literal["fp16", "fp32", "int8"]

EXACT: Final = Bars(evaluation=1e-4, sampling=60.0)
BARS: Final[dict[Weights, Bars]] = {"fp32": EXACT, "fp16": EXACT, "int8": Bars(evaluation=0.2, sampling=40.0)}
LARGE: Final = 1024  # elements; smaller tensors stay float32


@dataclass(frozen=True)
class MiniExportConfig:
    """How to run a network; the fields are those of the manifest."""

    name: str = "mini"
    grid: GridRule = field(default_factory=GridRule)
    schedule: ShiftSchedule = field(default_factory=lambda: ShiftSchedule(8.0))
    steps: int = 40
    guidance: float = 1.0
    noise_scale: float = 1.0


USUAL: Final = MiniExportConfig()


def export_checkpoint(
    checkpoint: Path,
    out: Path,
    *,
    lora: Path | None = None,
    config: MiniExportConfig = USUAL,
    weights: Weights = "fp16",
    overwrite: bool = False,
) -> Bundle:
    """Write the bundle of a checkpoint at `out`.

    checkpoint: a folder written by training, or its model.safetensors. lora: a peft folder to merge; by
    default lora/ in the checkpoint's folder, if it exists. config: its grid's multiple is set to the
    network's patch. Raises InputError for unusable files, and what `export_network` raises.
    """
    check_target(out, overwrite)
    if checkpoint.is_dir():
        checkpoint, lora = checkpoint / WEIGHTS, lora or _present(checkpoint / LORA)
    network = load_network(checkpoint)
    config = replace(config, grid=replace(config.grid, multiple=network.config.patch))
    merged = merge_lora(network, lora) if lora else network
    return export_network(merged, config, out, weights=weights, overwrite=overwrite)


def export_network(
    network: Mini, config: MiniExportConfig, out: Path, *, weights: Weights = "fp16", overwrite: bool = False
) -> Bundle:
    """Write a network's bundle at `out`.

    weights: how they are stored. Unless it is fp32, the network's weights are rounded to float16 in place.
    The graphs compute in float32; with int8, matrix products use integers. Raises InputError for an invalid
    config, ExportError if the graphs differ from torch with the same weights by more than `BARS`, and
    BundleError if nothing can be written.
    """
    check_target(out, overwrite)
    manifest, grid = describe(config, weights), config.grid
    network = network.eval()
    parity = {} if weights == "fp32" else {"weights_as_fp16": round_to_half(network, grid)}
    with tempfile.TemporaryDirectory() as scratch:
        parts: dict[str, Encode | Step] = {"encode": Encode(network), "velocity": Step(network)}
        files: dict[str, Path] = {}
        for name, part in parts.items():
            files |= write_graph(part, name, Path(scratch), grid.multiple, weights)
        engines = {name: open_checked(files[f"{name}.onnx"]) for name in parts}
        found = mini.Graphs(**engines)
        bars, sigmas = BARS[weights], config.schedule.sigmas(config.steps)
        parity["evaluation"] = check_evaluations(network, found, grid, bars)
        parity["sampling_db"] = check_sampling(network, found, grid, sigmas, config.guidance, bars)
        graphs = {
            name: Graph(f"{name}.onnx", engine.inputs, engine.outputs, f"{name}.npz")
            for name, engine in engines.items()
        }
        manifest = replace(manifest, graphs=graphs, parity=parity)
        return write_bundle(out, manifest, files, overwrite=overwrite)


class GraphPart(torch.nn.Module):
    """A part of a network that becomes one graph. outputs: their names, in order."""

    outputs: tuple[str, ...]

    def feeds(self, height: int, width: int, seed: int) -> Feeds:
        """Return random inputs by name, for a grid of that size."""
        raise NotImplementedError


class Encode(GraphPart):
    """The part of the network that computes the features of photo and strokes."""

    outputs = Features._fields

    def __init__(self, network: Mini) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, photo: torch.Tensor, light: torch.Tensor, mask: torch.Tensor, own: torch.Tensor
    ) -> Features:
        return encode_fused(self.network, photo, light, mask, own)

    def feeds(self, height: int, width: int, seed: int) -> Feeds:
        feeds = random_feeds(height, width, seed)
        own = np.random.default_rng(seed).random(feeds["photo"].shape, dtype=np.float32)
        return {name: feeds[name] for name in mini.SEEN} | {"own": own}


class Step(GraphPart):
    """The part of the network that computes the velocity from the features."""

    outputs = ("velocity",)

    def __init__(self, network: Mini) -> None:
        super().__init__()
        self.network = network
        self.fused = fused(network)

    def forward(
        self,
        x: torch.Tensor,
        sigma: torch.Tensor,
        mode: torch.Tensor,
        given: torch.Tensor,
        fine: torch.Tensor,
        half: torch.Tensor,
        quarter: torch.Tensor,
        tokens: torch.Tensor,
        cosine: torch.Tensor,
        sine: torch.Tensor,
    ) -> torch.Tensor:
        return self.fused.step(x, sigma, mode, given, fine, half, quarter, tokens, cosine, sine)

    def feeds(self, height: int, width: int, seed: int) -> Feeds:
        feeds = random_feeds(height, width, seed)
        features = answers(Encode(self.network), Encode(self.network).feeds(height, width, seed))
        return {name: feeds[name] for name in ("x", "sigma", "mode")} | features


def write_graph(part: GraphPart, name: str, folder: Path, multiple: int, weights: Weights) -> dict[str, Path]:
    """Write one graph and its probe: a small evaluation with the expected outputs. Return the two files.

    The expected outputs are torch's. For int8 they are the CPU's, because devices agree with each other
    more closely than int8 agrees with torch.
    """
    graph, probe = folder / f"{name}.onnx", folder / f"{name}.npz"
    convert(part, graph, multiple)
    if weights == "int8":
        multiply_in_int8(graph)
    if weights != "fp32":
        store_as_half(graph)
    feeds = part.feeds(2 * multiple, 3 * multiple, seed=1)
    right = Engine(graph).run(feeds) if weights == "int8" else answers(part, feeds)
    arrays: dict[str, Any] = {**feeds, **right}
    np.savez(probe, **arrays)
    return {graph.name: graph, probe.name: probe}


def answers(part: GraphPart, feeds: Feeds) -> dict[str, Array]:
    """Return torch's outputs by name. Raises ExportError if they are not finite."""
    with torch.inference_mode():
        found = part(**{name: torch.from_numpy(array) for name, array in feeds.items()})
    arrays = dict(zip(part.outputs, [found] if isinstance(found, torch.Tensor) else found, strict=True))
    if not all(array.isfinite().all() for array in arrays.values()):
        raise ExportError("The network computes what is no number; its weights are broken.")
    return {output: array.numpy() for output, array in arrays.items()}


def convert(part: GraphPart, path: Path, multiple: int) -> None:
    """Write a part of the network as one portable ONNX graph, optimised, with its weights inside.

    Batch, rows and columns vary; the grid's sides are multiples of `multiple`. Raises ExportError.
    """
    batch, rows, columns = Dim("batch", max=64), Dim("rows", max=256), Dim("columns", max=256)
    feeds = part.feeds(4 * multiple, 6 * multiple, seed=0)

    def shape(name: str, array: Array) -> dict[int, Any]:
        """Return the variable sides. A feature of 2 x 2 cells has half as many rows as the grid."""
        if array.ndim < 4:
            return {0: batch}
        if name in ("cosine", "sine"):
            return {0: batch, 1: rows, 2: columns}
        cells = array.shape[2] // 4
        down, along = (cells * rows, cells * columns) if cells > 1 else (rows, columns)
        return {0: batch, 2: down, 3: along}

    with _quiet():
        try:
            program = torch.onnx.export(
                part,
                kwargs={name: torch.from_numpy(array) for name, array in feeds.items()},
                dynamic_shapes={name: shape(name, array) for name, array in feeds.items()},
                input_names=list(feeds),
                output_names=list(part.outputs),
                opset_version=OPSET,
                custom_translation_table=TRANSLATIONS,
                dynamo=True,
                optimize=True,
                verbose=False,
            )
        except (torch.onnx.OnnxExporterError, RuntimeError, ValueError) as error:
            raise ExportError(f"The network cannot be written as an ONNX graph: {reason(error)}.") from error
    assert program is not None  # only the old exporter returns None
    ClearMetadataAndDocStringPass()(program.model)  # contains paths of this machine
    onnx_ir.save(program.model, path)


def round_to_half(network: torch.nn.Module, grid: GridRule) -> float:
    """Round the large weights to float16 values, in place.

    Return the largest change of one evaluation, relative to its largest value.
    """
    feeds = random_feeds(*grid.shape(1, 1), seed=0)
    before = evaluate(network, feeds)
    for weight in network.parameters():
        if weight.numel() >= LARGE:
            weight.data = weight.data.half().float()
    return relative_error(evaluate(network, feeds), before)


def multiply_in_int8(path: Path) -> None:
    """Change a graph's matrix products to weights of 7 bits and activations of 8 bits.

    Weights have one scale per output, activations one per call. With 8-bit weights, CPUs without VNNI would
    overflow without an error.
    """
    logging.disable(logging.WARNING)  # silences the advice to preprocess, which `convert` has done
    try:
        quantize_dynamic(
            path,
            path,
            op_types_to_quantize=["MatMul", "Gemm"],
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
        )
    finally:
        logging.disable(logging.NOTSET)


def store_as_half(path: Path) -> None:
    """Store large weights as float16 where that is exact, and cast them when the graph is loaded."""
    model = onnx.load(path)
    casts = []
    for tensor in model.graph.initializer:
        weight = numpy_helper.to_array(tensor)
        with np.errstate(over="ignore"):
            half = weight.astype(np.float16)
        if weight.dtype == np.float32 and weight.size >= LARGE and np.array_equal(half, weight):
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(half, f"{name}.half"))
            casts.append(helper.make_node("Cast", [tensor.name], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, path)


def open_checked(graph: Path) -> Engine:
    """Check the graph with ONNX and open it in ONNX Runtime. Raises ExportError."""
    try:
        onnx.checker.check_model(graph, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise ExportError(f"The network became a graph that is not valid ONNX: {reason(error)}.") from error
    return Engine(graph)


def describe(config: MiniExportConfig, weights: Weights, family: str = "mini") -> Manifest:
    """Return the manifest of an export before its graphs exist. Raises InputError for an invalid config."""
    try:
        return Manifest(
            family=family,
            name=config.name,
            licence="Apache-2.0",
            precision=weights,
            files={},
            graphs={},
            schedule=config.schedule,
            steps=config.steps,
            guidance=config.guidance,
            grid=config.grid,
            noise_scale=config.noise_scale,
            parity={},
        )
    except ValueError as error:
        raise InputError(f"The model cannot be run with these settings: {reason(error)}.") from error


def _present(folder: Path) -> Path | None:
    return folder if folder.is_dir() else None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence torch.onnx, which warns of packages that are not needed and of its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
