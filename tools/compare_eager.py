"""The shipped model's sampler over ONNX Runtime beside torch eager: same weights, steps, noise and threads.

python -m tools.compare_eager [--threads 2] [--runs 5]

Runs take turns; the ratio is of medians. Needs dior-rt[train,export].
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.export.check import random_condition
from dior_rt.export.lora import merge_lora
from dior_rt.families.mini import Mini, null
from dior_rt.flow.sampler import Array, Condition, Velocity, draw_noise, guided, sample
from dior_rt.training.network import LORA, WEIGHTS, load_network
from tools.command import start

CHECKPOINT = Path(__file__).parents[1] / "training/checkpoints/mini"


def main(
    threads: Annotated[int, typer.Option(min=1)] = 2, runs: Annotated[int, typer.Option(min=1)] = 5
) -> None:
    """Seconds of all steps for a photo of 600 x 400 pixels, with and without guidance."""
    torch.set_num_threads(threads)
    bundle = read_bundle(default_bundle())
    family, bind_torch = Mini(bundle, "cpu", threads), eager()
    condition = random_condition(*family.raster(400, 600), "relight", seed=0)
    sigmas = family.sigmas(bundle.manifest.steps, condition)
    noise = draw_noise(0, family.noise_shape(condition))
    for guidance in (1.0, 2.0):
        ways: list[Callable[[], Velocity]] = [
            partial(guided, bind_torch, condition, null(condition), guidance),
            partial(family.velocity, condition, sigmas, guidance),
        ]
        runs_of = [[walk(way, noise, sigmas) for way in ways] for _ in range(runs + 1)][1:]
        torch_s, runtime_s = (statistics.median(run[k][0] for run in runs_of) for k in (0, 1))
        error = np.abs(runs_of[0][0][1] - runs_of[0][1][1]).max()
        typer.echo(f"guidance {guidance:g}, {len(sigmas) - 1} steps, {threads} threads:")
        typer.echo(
            f"  torch eager {torch_s:.3f} s, ONNX Runtime {runtime_s:.3f} s, {torch_s / runtime_s:.2f} x"
        )
        typer.echo(f"  largest difference of the state {error:.1e}")


def walk(bind: Callable[[], Velocity], noise: Array, sigmas: Array) -> tuple[float, Array]:
    """Seconds of a whole run, and its end."""
    began = time.perf_counter()
    *_, last = sample(bind(), noise, sigmas)
    return time.perf_counter() - began, last.x


def eager() -> Callable[[Condition], Velocity]:
    """The network in torch, which also looks at photo and strokes once only."""
    network = merge_lora(load_network(CHECKPOINT / WEIGHTS), CHECKPOINT / LORA).eval()

    @torch.inference_mode()
    def bind(condition: Condition) -> Velocity:
        inputs = {name: torch.from_numpy(array) for name, array in condition.items()}
        source = network.estimate_source(inputs["photo"])
        features = network.encode(inputs["photo"], inputs["light"], inputs["mask"], source)

        @torch.inference_mode()
        def velocity(x: Array, sigma: float) -> Array:
            sigmas = torch.full((len(x),), sigma)
            return network.step(torch.from_numpy(x), sigmas, inputs["mode"], *features).numpy()

        return velocity

    return bind


if __name__ == "__main__":
    start(main)
