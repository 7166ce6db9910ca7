"""Mini to a bundle: torch's network becomes one ONNX graph, with its weights stored small, held to torch."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import onnx
import onnx_ir
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx_ir.passes.common import ClearMetadataAndDocStringPass
from torch.export import Dim

from dior_rt.bundle import Bundle, Graph, Manifest, check_target, write_bundle
from dior_rt.engine import Engine
from dior_rt.errors import InputError
from dior_rt.export.check import (
    ExportError,
    check_evaluations,
    check_sampling,
    evaluate,
    random_feeds,
    relative_error,
)
from dior_rt.export.lora import merge_lora
from dior_rt.family import mini
from dior_rt.files import reason
from dior_rt.grid import GridRule
from dior_rt.schedule import ShiftSchedule
from dior_rt.training.network import LORA, WEIGHTS, load_network

Weights = Literal["fp16", "fp32"]

GRAPH: Final = "model.onnx"
PROBE: Final = "probe.npz"
LARGE: Final = 1024  # elements; smaller tensors stay float32, they weigh nothing


@dataclass(frozen=True)
class Recipe:
    """How a network wants to be run; the fields are the manifest's."""

    name: str = "mini"
    grid: GridRule = field(default_factory=GridRule)
    schedule: ShiftSchedule = field(default_factory=lambda: ShiftSchedule(8.0))
    steps: int = 40
    guidance: float = 1.0
    noise_scale: float = 1.0


USUAL: Final = Recipe()


def export_checkpoint(
    checkpoint: Path,
    out: Path,
    *,
    lora: Path | None = None,
    recipe: Recipe = USUAL,
    weights: Weights = "fp16",
    overwrite: bool = False,
) -> Bundle:
    """Write the bundle of a checkpoint at `out`.

    checkpoint: a folder that training wrote, or its model.safetensors. lora: a folder of peft's to be
    merged; of a checkpoint's folder it is lora/, where there is one. recipe: its grid's multiple is set to
    the network's patch. Raises InputError for files that cannot be used, and what `export_network` raises.
    """
    check_target(out, overwrite)
    if checkpoint.is_dir():
        checkpoint, lora = checkpoint / WEIGHTS, lora or _present(checkpoint / LORA)
    network = load_network(checkpoint)
    recipe = replace(recipe, grid=replace(recipe.grid, multiple=network.config.patch))
    merged = merge_lora(network, lora) if lora else network
    return export_network(merged, recipe, out, weights=weights, overwrite=overwrite)


def export_network(
    network: torch.nn.Module, recipe: Recipe, out: Path, *, weights: Weights = "fp16", overwrite: bool = False
) -> Bundle:
    """Write a network's bundle at `out`. Its inputs and output are those of mini in docs/contracts.md.

    weights: how they are stored; for fp16 the network's own are rounded in place. The graph computes in
    float32 either way. Raises InputError for a recipe that cannot be, ExportError where the graph computes
    something else than torch with the same weights, and BundleError where nothing can be written.
    """
    check_target(out, overwrite)
    manifest, grid = describe(recipe, weights), recipe.grid
    network = network.eval()
    parity = {"weights_as_fp16": round_to_half(network, grid)} if weights == "fp16" else {}
    with tempfile.TemporaryDirectory() as scratch:
        graph, probe = Path(scratch) / GRAPH, Path(scratch) / PROBE
        convert(network, graph, grid.multiple)
        if weights == "fp16":
            store_as_half(graph)
        engine = open_checked(graph)
        bind, sigmas = partial(mini.bind, engine), recipe.schedule.sigmas(recipe.steps)
        parity["evaluation"] = check_evaluations(network, engine, grid)
        parity["sampling_db"] = check_sampling(network, bind, grid, sigmas, recipe.guidance)
        save_probe(network, probe, grid)
        graphs = {"velocity": Graph(GRAPH, engine.inputs, engine.outputs, PROBE)}
        manifest = replace(manifest, graphs=graphs, parity=parity)
        return write_bundle(out, manifest, {GRAPH: graph, PROBE: probe}, overwrite=overwrite)


def convert(network: torch.nn.Module, path: Path, multiple: int) -> None:
    """Write the network as one portable ONNX graph, optimised, with its weights inside.

    Batch, rows and columns are free; sides are multiples of `multiple`. Raises ExportError.
    """
    batch = Dim("batch", max=64)
    planes = {0: batch, 2: multiple * Dim("rows", max=256), 3: multiple * Dim("columns", max=256)}
    feeds = random_feeds(4 * multiple, 6 * multiple, seed=0)
    shapes = {name: planes if array.ndim == 4 else {0: batch} for name, array in feeds.items()}
    with _quiet():
        try:
            program = torch.onnx.export(
                network,
                kwargs={name: torch.from_numpy(array) for name, array in feeds.items()},
                dynamic_shapes=shapes,
                input_names=list(feeds),
                output_names=["velocity"],
                dynamo=True,
                optimize=True,
                verbose=False,
            )
        except (torch.onnx.OnnxExporterError, RuntimeError, ValueError) as error:
            raise ExportError(f"The network cannot be written as an ONNX graph: {reason(error)}.") from error
    assert program is not None  # only the old exporter returns None
    ClearMetadataAndDocStringPass()(program.model)  # it names the source files of this machine
    onnx_ir.save(program.model, path)


def round_to_half(network: torch.nn.Module, grid: GridRule) -> float:
    """Round the large weights to what float16 can hold, in place.

    Returns what that costs: the largest change of one evaluation, relative to its largest value.
    """
    feeds = random_feeds(*grid.shape(1, 1), seed=0)
    before = evaluate(network, feeds)
    for weight in network.parameters():
        if weight.numel() >= LARGE:
            weight.data = weight.data.half().float()
    return relative_error(evaluate(network, feeds), before)


def store_as_half(path: Path) -> None:
    """Store the large weights of a graph as float16 wherever that loses nothing, and cast them on loading."""
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


def save_probe(network: torch.nn.Module, path: Path, grid: GridRule) -> None:
    """The bundle's self-test: one small evaluation, and what torch answers."""
    feeds = random_feeds(2 * grid.multiple, 3 * grid.multiple, seed=1)
    arrays: dict[str, Any] = {**feeds, "velocity": evaluate(network, feeds)}
    np.savez(path, **arrays)


def open_checked(graph: Path) -> Engine:
    """The graph in ONNX Runtime, after ONNX's own checker. Raises ExportError."""
    try:
        onnx.checker.check_model(graph, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise ExportError(f"The network became a graph that is not valid ONNX: {reason(error)}.") from error
    return Engine(graph)


def describe(recipe: Recipe, weights: Weights) -> Manifest:
    """The manifest of an export, before its graph is made. Raises InputError for a recipe that cannot be."""
    try:
        return Manifest(
            family="mini",
            name=recipe.name,
            licence="Apache-2.0",
            precision=weights,
            files={},
            graphs={},
            schedule=recipe.schedule,
            steps=recipe.steps,
            guidance=recipe.guidance,
            colour="srgb",
            grid=recipe.grid,
            noise_scale=recipe.noise_scale,
            parity={},
            settings={},
        )
    except ValueError as error:
        raise InputError(f"The model cannot be run so: {reason(error)}.") from error


def _present(folder: Path) -> Path | None:
    return folder if folder.is_dir() else None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """torch.onnx speaks of packages that are not needed and of its own deprecations."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
