"""The training loop: stage 1 from nothing, or a LoRA on top of it. One loop, whatever is being trained.

Loss: the squared error of x0, which for relighting is the squared error of the relit sRGB picture (times 16) and for
estimation that of the encoded Lumi map. Half of the samples are drawn at sigma = 1, where the whole answer has to
come from the condition; the others at sigmas shifted towards it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from accelerate import Accelerator
from peft import LoraConfig, PeftModel, get_peft_model
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader

from dior_rt.training.network import Config, Mini, load_network, save_network
from dior_rt.training.triplets import Batches, load_views

WEIGHTS: Final = "model.safetensors"  # what export reads: the average of the weights
STATE: Final = "state.safetensors"  # what a run resumes from
LORA: Final = "lora"
LORA_TARGETS: Final = ["qkv", "proj", "up", "down", "modulation", "unembed"]


@dataclass(frozen=True)
class Plan:
    """How to train. The rate warms up, stays, and falls to 0 over the last fifth of the steps, so a longer plan can
    resume from any state that came before the fall. average: the half-life of the weights' average, in steps."""

    steps: int
    batch: int = 32
    rate: float = 8e-4
    warmup: int = 200
    decay: float = 0.2
    average: int = 150
    weight_decay: float = 0.02
    clip: float = 1.0
    shift: float = 8.0
    always_noise: float = 0.5
    seed: int = 0
    precision: str = "no"  # or "bf16", as accelerate names it
    save_every: int = 200

    def rate_at(self, step: int) -> float:
        falling = (self.steps - step) / max(self.decay * self.steps, 1)
        return self.rate * min(1.0, (step + 1) / self.warmup, max(falling, 0.0))


Progress = Callable[[int, float], None]  # step, running loss


def fit(renders: Path, out: Path, config: Config, plan: Plan, progress: Progress | None = None) -> Path:
    """Train stage 1 on a folder of renders; resumes where `out` holds a state. Returns the weights' path."""
    return _run(
        Mini(config), renders, out, plan, progress, lambda average: save_network(average, out / WEIGHTS)
    )


def fit_lora(
    base: Path, renders: Path, out: Path, rank: int, plan: Plan, progress: Progress | None = None
) -> Path:
    """Train a LoRA of the given rank on the network at `base`; `out` receives the base's weights and `lora/`."""
    network = load_network(base)
    adapted = get_peft_model(network, LoraConfig(r=rank, lora_alpha=rank, target_modules=LORA_TARGETS))  # type: ignore[arg-type]
    out.mkdir(parents=True, exist_ok=True)
    save_network(load_network(base), out / WEIGHTS)

    def save(average: nn.Module) -> None:
        assert isinstance(average, PeftModel)
        average.save_pretrained(str(out / LORA), safe_serialization=True)

    return _run(adapted, renders, out, plan, progress, save)


def flow_loss(network: nn.Module, batch: dict[str, Tensor], sigma: Tensor, noise: Tensor) -> Tensor:
    """Mean squared error of x0 at flow times sigma (B,); the network sees x = (1 - sigma) x0 + sigma noise."""
    s = sigma[:, None, None, None]
    x0 = batch["x0"]
    x = (1 - s) * x0 + s * noise
    inputs = {name: batch[name] for name in ("photo", "light", "mask", "mode")}
    velocity = network(x=x, sigma=sigma, **inputs)
    return (x - s * velocity - x0).square().mean()


def draw_sigma(count: int, plan: Plan, generator: torch.Generator) -> Tensor:
    """(count,) flow times: 1 for a share of the samples, else u -> s u / (1 + (s - 1) u) of a uniform u."""
    u = torch.rand(count, generator=generator)
    shifted = (plan.shift * u / (1 + (plan.shift - 1) * u)).clamp_min(0.02)
    return torch.where(torch.rand(count, generator=generator) < plan.always_noise, torch.ones(count), shifted)


def _run(
    network: nn.Module,
    renders: Path,
    out: Path,
    plan: Plan,
    progress: Progress | None,
    save: Callable[[nn.Module], object],
) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    accelerator = Accelerator(mixed_precision=plan.precision)
    trained = [weight for weight in network.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=plan.rate, betas=(0.9, 0.99), weight_decay=plan.weight_decay)
    average = Average(trained, plan.average)
    step = _resume(out / STATE, trained, optimizer, average)
    rank = accelerator.process_index
    batches = Batches(load_views(renders), plan.batch, plan.seed, start=step, rank=rank)
    # Two processes at most share the cores with the training; the batches do not depend on how many there are.
    loader = DataLoader(batches, batch_size=None, num_workers=1, prefetch_factor=4)
    network, optimizer = accelerator.prepare(network, optimizer)
    network.train()
    running = math.nan
    for batch in loader:
        if step >= plan.steps:
            break
        for group in optimizer.param_groups:
            group["lr"] = plan.rate_at(step)
        generator = torch.Generator().manual_seed(hash((plan.seed, rank, step)) % 2**63)
        sigma = draw_sigma(plan.batch, plan, generator).to(accelerator.device)
        noise = torch.randn(batch["x0"].shape, generator=generator).to(accelerator.device)
        moved = {name: value.to(accelerator.device) for name, value in batch.items()}
        with accelerator.autocast():
            loss = flow_loss(network, moved, sigma, noise)
        accelerator.backward(loss)
        accelerator.clip_grad_norm_(trained, plan.clip)
        optimizer.step()
        optimizer.zero_grad()
        average.update(trained)
        step += 1
        value = float(loss.detach())
        running = value if math.isnan(running) else 0.98 * running + 0.02 * value
        if progress:
            progress(step, running)
        if accelerator.is_main_process and (step % plan.save_every == 0 or step == plan.steps):
            _store(out / STATE, trained, optimizer, average, step)
            with average.swapped(trained):
                save(accelerator.unwrap_model(network))
    return out


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
        with torch.no_grad():
            for mean, weight in zip(self.values, weights, strict=True):
                mean.lerp_(weight.detach(), 1 - decay)

    def swapped(self, weights: list[nn.Parameter]) -> _Swap:
        """Within it the weights hold their average."""
        return _Swap(weights, self.values)


class _Swap:
    def __init__(self, weights: list[nn.Parameter], values: list[Tensor]) -> None:
        self.weights, self.values = weights, values

    def __enter__(self) -> None:
        self.kept = [weight.detach().clone() for weight in self.weights]
        self._set(self.values)

    def __exit__(self, *_: object) -> None:
        self._set(self.kept)

    def _set(self, values: list[Tensor]) -> None:
        with torch.no_grad():
            for weight, value in zip(self.weights, values, strict=True):
                weight.copy_(value)


def _store(
    path: Path, weights: list[nn.Parameter], optimizer: torch.optim.Optimizer, average: Average, step: int
) -> None:
    """Everything a run needs to go on, in one safetensors file, replaced whole."""
    tensors: dict[str, Tensor] = {}
    for k, (weight, mean) in enumerate(zip(weights, average.values, strict=True)):
        moments = optimizer.state[weight]
        tensors |= {f"{k}.weight": weight.detach(), f"{k}.average": mean}
        tensors |= {f"{k}.first": moments["exp_avg"], f"{k}.second": moments["exp_avg_sq"]}
    head = {"step": step, "updates": average.updates}
    partial = path.with_suffix(".partial")
    save_file(
        {name: t.contiguous() for name, t in tensors.items()}, partial, metadata={"head": json.dumps(head)}
    )
    partial.replace(path)


def _resume(
    path: Path, weights: list[nn.Parameter], optimizer: torch.optim.Optimizer, average: Average
) -> int:
    """Put a stored state back; the step to go on from, 0 where there is none."""
    if not path.exists():
        return 0
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        head = json.loads(file.metadata()["head"])
    tensors = load_file(path)
    with torch.no_grad():
        for k, weight in enumerate(weights):
            weight.copy_(tensors[f"{k}.weight"])
            average.values[k].copy_(tensors[f"{k}.average"])
            optimizer.state[weight] = {
                "step": torch.tensor(float(head["step"])),
                "exp_avg": tensors[f"{k}.first"],
                "exp_avg_sq": tensors[f"{k}.second"],
            }
    average.updates = head["updates"]
    return int(head["step"])
