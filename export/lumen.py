"""Lumen to a bundle: the scene network and the light network become two ONNX graphs, held to torch.

"scene" reads the photo, once a photo; "light" is what every step of the flow costs.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from torch import Tensor

from dior_rt.bundle import Bundle, Graph, check_target, write_bundle
from dior_rt.engine import Engine, Feeds
from dior_rt.export.check import ExportError, relative_error
from dior_rt.export.mini import (
    LARGE,
    GraphPart,
    MiniExportConfig,
    answers,
    describe,
    open_checked,
    write_graph,
)
from dior_rt.families import lumen
from dior_rt.flow.sampler import draw_noise
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.grid import GridRule
from dior_rt.training.lumen.checkpoint import load_lumen
from dior_rt.training.lumen.completion import Strokes
from dior_rt.training.lumen.config import PATCH
from dior_rt.training.lumen.model import Lumen
from dior_rt.training.lumen.scene import Scene

Weights = Literal["fp16", "fp32"]
LARGEST_ERROR: Final = 1e-3  # of one evaluation, of its largest value
SIGMAS: Final = (1.0, 0.9, 0.5, 0.1)


@dataclass(frozen=True)
class LumenExportConfig(MiniExportConfig):
    """How to run a network: mini's fields with other defaults."""

    name: str = "lumen"
    grid: GridRule = field(default_factory=lambda: GridRule(cells=16384, multiple=PATCH, longest=512))
    schedule: ShiftSchedule = field(default_factory=lambda: ShiftSchedule(3.0))
    steps: int = 1


class SceneGraph(GraphPart):
    """What a photo shows, by name."""

    outputs = lumen.SCENE

    def __init__(self, network: Lumen) -> None:
        super().__init__()
        self.scene = network.scene

    def forward(self, photo: Tensor) -> tuple[Tensor, ...]:
        found = self.scene(photo)
        return tuple(getattr(found, name) for name in self.outputs)

    def feeds(self, height: int, width: int, seed: int) -> Feeds:
        photo = np.random.default_rng(seed).random((len(SIGMAS), 3, height, width), dtype=np.float32)
        return {"photo": photo}


class LightGraph(GraphPart):
    """The velocity of the flow, from a photo's scene and strokes of one blend mode."""

    outputs = ("velocity",)

    def __init__(self, network: Lumen) -> None:
        super().__init__()
        self.light, self.network = network.light, network

    def forward(
        self,
        x: Tensor,
        sigma: Tensor,
        photo: Tensor,
        light: Tensor,
        normal: Tensor,
        depth: Tensor,
        sky: Tensor,
        fine: Tensor,
        half: Tensor,
        quarter: Tensor,
        tokens: Tensor,
        drawn: Tensor,
        mask: Tensor,
        blend: Tensor,
        far: Tensor,
    ) -> Tensor:
        scene = Scene(light, normal, depth, sky, light, light, fine, half, quarter, tokens)
        x0 = self.light(x, sigma, photo, scene, Strokes(drawn, mask, blend, far)).x0
        return (x - x0) / sigma[:, None, None, None]

    def feeds(self, height: int, width: int, seed: int) -> Feeds:
        rng = np.random.default_rng(seed)
        seen = SceneGraph(self.network).feeds(height, width, seed)
        scene = answers(SceneGraph(self.network), seen)
        count = len(SIGMAS)
        return {
            "x": draw_noise(seed, (count, 3, height, width)),
            "sigma": np.array(SIGMAS, np.float32),
            "photo": seen["photo"],
            **{name: scene[name] for name in lumen.GIVEN},
            "drawn": rng.exponential(1.0, (count, 3, height, width)).astype(np.float32),
            "mask": (rng.random((count, 1, height, width)) < 0.2).astype(np.float32),
            "blend": np.arange(count, dtype=np.int64) % 3,
            "far": np.arange(count, dtype=np.int64) // 2 % 2,
        }


def export_lumen(
    checkpoint: Path,
    out: Path,
    *,
    config: LumenExportConfig = LumenExportConfig(),
    weights: Weights = "fp16",
    overwrite: bool = False,
) -> Bundle:
    """Write the bundle of a checkpoint at `out`.

    weights: how they are stored; the graphs compute in float32. Raises InputError for files that cannot be
    used, ExportError where the graphs compute something else than torch, and BundleError where nothing can
    be
    written.
    """
    check_target(out, overwrite)
    return export_network(load_lumen(checkpoint), out, config, weights, overwrite)


def export_network(
    network: Lumen, out: Path, config: LumenExportConfig, weights: Weights = "fp16", overwrite: bool = False
) -> Bundle:
    """Write a network's bundle at `out`; with fp16 its large weights are rounded in place."""
    network = network.eval()
    if weights == "fp16":
        for weight in network.parameters():
            if weight.numel() >= LARGE:
                weight.data = weight.data.half().float()
    manifest = describe(config, weights, "lumen")
    with tempfile.TemporaryDirectory() as scratch:
        parts: dict[str, GraphPart] = {
            "scene": SceneGraph(network),
            "light": LightGraph(network),
        }
        files: dict[str, Path] = {}
        for name, part in parts.items():
            files |= write_graph(part, name, Path(scratch), config.grid.multiple, weights)
        engines = {name: open_checked(files[f"{name}.onnx"]) for name in parts}
        worst = max(error_of(parts[name], engine, config.grid) for name, engine in engines.items())
        if not worst <= LARGEST_ERROR:
            raise ExportError(
                f"The graphs are off by {worst:.2g} of their largest value; {LARGEST_ERROR:g} is allowed."
            )
        graphs = {
            name: Graph(f"{name}.onnx", engine.inputs, engine.outputs, f"{name}.npz")
            for name, engine in engines.items()
        }
        manifest = replace(manifest, graphs=graphs, parity={"evaluation": worst})
        return write_bundle(out, manifest, files, overwrite=overwrite)


def error_of(part: GraphPart, engine: Engine, grid: GridRule) -> float:
    """The largest relative error of a graph against torch, over several grids."""
    worst = 0.0
    for height, width in (grid.shape(1, 1), grid.shape(2, 3), (2 * PATCH, 3 * PATCH)):
        feeds = part.feeds(height, width, seed=height)
        right, found = answers(part, feeds), engine.run(feeds)
        worst = max(worst, *(relative_error(found[name], right[name]) for name in part.outputs))
    return worst if math.isfinite(worst) else math.inf
