"""A training run: network, average, optimiser and clock; stored in parts, resumed on any device."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor, nn

from dior_rt.errors import InputError
from dior_rt.files import reason, replacing
from dior_rt.training.lumen.checkpoint import AVERAGE, INDEX, STATE, read_parts, write_parts
from dior_rt.training.lumen.clock import Clock
from dior_rt.training.lumen.model import Lumen

BACKBONE_RATE: Final = 0.25  # factor on the learning rate: pretrained weights move less


@dataclass
class Run:
    """The parts that change while a network trains. average: that of the weights, in the network's order."""

    network: Lumen
    average: list[Tensor]
    optimizer: torch.optim.Optimizer
    clock: Clock
    rate: float

    @staticmethod
    def begin(network: Lumen, clock: Clock, rate: float, weight_decay: float) -> Run:
        """Return a run of a network on its device. rate: the largest learning rate of AdamW."""
        average = [weight.detach().clone() for weight in network.parameters()]
        return Run(network, average, make_optimizer(network, rate, weight_decay), clock, rate)

    def advance(self, largest: float) -> Tensor:
        """Take the optimiser's step with gradients of a norm of at most `largest`, and count it.

        Returns 1 where a gradient was not finite. The weights then move by momentum alone.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate * group["share"] * self.clock.rate
        weights = list(self.network.parameters())
        skipped = clip(weights, largest)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            torch._foreach_lerp_(
                self.average, [weight.detach() for weight in weights], self.clock.average_share
            )
        self.clock.tick()
        return skipped

    def store(self, out: Path) -> None:
        """Write the average in float16, then the weights and their moments, and the index last."""
        names = [name for name, _ in self.network.named_parameters()]
        write_parts(out, AVERAGE, {name: mean.half() for name, mean in zip(names, self.average, strict=True)})
        state: dict[str, Tensor] = {}
        for name, weight in self.network.named_parameters():
            moments = self.optimizer.state[weight]
            state[f"weight.{name}"] = weight.detach()
            state[f"first.{name}"] = moments["exp_avg"].bfloat16()
            state[f"second.{name}"] = moments["exp_avg_sq"].bfloat16()
        write_parts(out, STATE, state)
        head = {"step": self.clock.step, "spent": self.clock.spent, "config": asdict(self.network.config)}
        with replacing(out / INDEX) as file:
            file.write(json.dumps(head).encode())

    @torch.no_grad()
    def resume(self, out: Path) -> None:
        """Load what `store` wrote or, without the state's files, the average. Raises InputError."""
        try:
            head = json.loads((out / INDEX).read_text())
            means, state = read_parts(out, AVERAGE), read_parts(out, STATE)
            for (name, weight), mean in zip(self.network.named_parameters(), self.average, strict=True):
                mean.copy_(means[name])
                weight.copy_(state.get(f"weight.{name}", means[name]))
                if f"first.{name}" in state:
                    self.optimizer.state[weight] = {
                        "step": torch.tensor(float(head["step"]), device=weight.device),
                        "exp_avg": torch.empty_like(weight).copy_(state[f"first.{name}"]),
                        "exp_avg_sq": torch.empty_like(weight).copy_(state[f"second.{name}"]),
                    }
            self.clock.step, self.clock.spent = int(head["step"]), float(head["spent"])
        except (OSError, KeyError, ValueError, RuntimeError) as error:
            raise InputError(f"The run in {out} cannot go on: {reason(error)}.") from error


def make_optimizer(network: Lumen, rate: float, weight_decay: float) -> torch.optim.Optimizer:
    """Return AdamW. Matrices decay, biases and scales do not, and the backbone moves less."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for name, weight in network.named_parameters():
        share = BACKBONE_RATE if name.startswith("scene.backbone") else 1.0
        groups.setdefault((share, weight_decay if weight.ndim > 1 else 0.0), []).append(weight)
    rows = [
        {"params": weights, "share": share, "weight_decay": decay}
        for (share, decay), weights in groups.items()
    ]
    return torch.optim.AdamW(rows, lr=rate, betas=(0.9, 0.98), fused=True)


def clip(weights: list[nn.Parameter], largest: float) -> Tensor:
    """Scale the gradients to a norm of at most `largest`.

    If any is not finite, all become 0, and 1 is returned.
    """
    gradients = [weight.grad for weight in weights if weight.grad is not None]
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
    bad = ~norm.isfinite()
    factor = torch.where(bad, torch.zeros_like(norm), (largest / (norm + 1e-6)).clamp(max=1))
    for gradient in gradients:
        gradient.nan_to_num_(0.0, 0.0, 0.0)
    torch._foreach_mul_(gradients, factor)
    return bad.float()
