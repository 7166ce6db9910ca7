"""The state of a training run that is needed to resume: trained weights, their average, AdamW's moments, the
step.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from dior_rt.errors import InputError
from dior_rt.files import reason, replacing

MOMENTS: Final = {"first": "exp_avg", "second": "exp_avg_sq"}  # the names of this module, and those of torch


class Average:
    """The exponential moving average of some weights, with the half-life given in steps."""

    def __init__(self, weights: list[nn.Parameter], half_life: int) -> None:
        self.decay = 0.5 ** (1 / half_life)
        self.values = [weight.detach().clone() for weight in weights]
        self.updates = 0

    def update(self, weights: list[nn.Parameter]) -> None:
        self.updates += 1
        # While there are few updates a plain mean of them is the better average.
        decay = min(self.decay, self.updates / (self.updates + 9))
        for mean, weight in zip(self.values, weights, strict=True):
            mean.lerp_(weight.detach(), 1 - decay)


@dataclass
class State:
    """A run after `step` steps. weights: the trained weights, in the network's order."""

    weights: list[nn.Parameter]
    optimizer: torch.optim.Optimizer
    average: Average
    step: int = 0

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Set the weights to their average within the block."""
        kept = [weight.detach().clone() for weight in self.weights]
        _fill(self.weights, self.average.values)
        try:
            yield
        finally:
            _fill(self.weights, kept)

    def store(self, path: Path) -> None:
        """Write everything as one safetensors file, whole or not at all. Raises InputError."""
        tensors: dict[str, Tensor] = {}
        for k, (weight, mean) in enumerate(zip(self.weights, self.average.values, strict=True)):
            tensors |= {f"{k}.weight": weight.detach(), f"{k}.average": mean}
            moments = self.optimizer.state[weight]
            tensors |= {f"{k}.{name}": moments[key] for name, key in MOMENTS.items()}
        head = {"step": self.step, "updates": self.average.updates}
        contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
        with replacing(path) as file:
            file.write(save(contiguous, {"head": json.dumps(head)}))

    def resume(self, path: Path) -> None:
        """Load what `store` wrote. Raises InputError for a file of another network, or of another kind."""
        try:
            with safe_open(path, "pt") as file:
                head = json.loads(file.metadata()["head"])
            tensors = load_file(path)
            # copy_ would broadcast a weight of another shape.
            shapes = [tensors[f"{k}.weight"].shape for k in range(len(tensors) // 4)]
            if shapes != [weight.shape for weight in self.weights]:
                raise ValueError("the network that it trained has another size")
            _fill(self.weights, [tensors[f"{k}.weight"] for k in range(len(shapes))])
            _fill(self.average.values, [tensors[f"{k}.average"] for k in range(len(shapes))])
            for k, weight in enumerate(self.weights):
                # The moment gets the layout of the weight, which the fused optimiser requires.
                moments = {
                    key: torch.empty_like(weight).copy_(tensors[f"{k}.{name}"])
                    for name, key in MOMENTS.items()
                }
                self.optimizer.state[weight] = {"step": torch.tensor(float(head["step"])), **moments}
            self.average.updates, self.step = int(head["updates"]), int(head["step"])
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"The run in {path.parent} cannot go on: {reason(error)}.") from error


@torch.no_grad()
def _fill(weights: list[nn.Parameter] | list[Tensor], values: list[Tensor]) -> None:
    for weight, value in zip(weights, values, strict=True):
        weight.copy_(value)
