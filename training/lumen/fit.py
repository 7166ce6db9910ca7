"""The training loop on one device, planned by time or by steps."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch
from torch import Tensor, nn

from dior_rt.errors import InputError
from dior_rt.files import make_folder, reason, replacing
from dior_rt.training.lumen.backbone import load_imagenet
from dior_rt.training.lumen.batches import Batch, BatchMaker
from dior_rt.training.lumen.checkpoint import AVERAGE, INDEX, STATE, load_lumen, read_parts, write_parts
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.loss import loss
from dior_rt.training.lumen.materials import load_tiles
from dior_rt.training.lumen.model import Lumen
from dior_rt.training.lumen.pack import load_shards

SIZES: Final = LumenConfig()
WARM_UP: Final = 0.04
DECAY: Final = 0.35
BACKBONE_RATE: Final = 0.25  # factor on the learning rate: pretrained weights move less
AVERAGED: Final = 0.06  # the time constant of the weights' average, as a share of the run


@dataclass(frozen=True)
class FitConfig:
    """The options of training.

    minutes: of training, loading and compiling included; None: `steps` decide.
    steps: of the optimiser, where minutes is None.
    batch: samples a step.
    rate: AdamW's largest learning rate.
    one_step: share of samples without any state, as the first step of sampling sees it.
    precision: "auto" is bf16 on CUDA and on CPUs with bf16 instructions, else fp32.
    """

    minutes: float | None = None
    steps: int = 1000
    batch: int = 32
    rate: float = 1e-3
    weight_decay: float = 0.02
    clip: float = 1.0
    one_step: float = 0.7
    shift: float = 3.0
    seed: int = 0
    precision: str = "auto"
    compiled: bool = False
    save_every: float = 60.0


@dataclass
class Clock:
    """The share of a run that is done, 0..1, by time or by steps.

    A resumed run continues where it stopped.
    """

    config: FitConfig
    step: int = 0
    spent: float = 0.0  # seconds

    setup: float = 0.0  # seconds of this process before training ran at full speed

    @property
    def done(self) -> float:
        if self.config.minutes is not None:
            return self.spent / max(60 * self.config.minutes - self.setup, 1.0)
        return self.step / self.config.steps

    @property
    def rate(self) -> float:
        """Return the learning rate: it warms up, stays, and falls to 0."""
        warm = min(1.0, (self.step + 1) / 100, self.done / WARM_UP + 0.01)
        return warm * min(1.0, max(0.0, (1 - self.done) / DECAY))


Progress = Callable[[int, float, dict[str, float]], None]  # step, share done, running errors


def fit(
    packs: Path,
    out: Path,
    config: FitConfig,
    sizes: LumenConfig = SIZES,
    backbone: Path | None = None,
    surfaces: Path | None = None,
    start: Path | None = None,
    progress: Progress | None = None,
) -> None:
    """Train on the shards in `packs`.

    The folder `out` receives the state in parts, and training resumes from it.

    sizes: of a new network. start: the checkpoint of another run to continue from instead, with a new
    schedule. backbone: ImageNet weights for the features. surfaces: a folder of surface sheets, for new
    materials. Raises InputError for files that cannot be used, and where training diverges.
    """
    make_folder(out)
    torch.manual_seed(config.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    network = load_lumen(start).train() if start is not None else Lumen(sizes)
    if backbone is not None:
        load_imagenet(network.scene.backbone, backbone)
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = [weight.detach().clone() for weight in network.parameters()]
    optimizer = make_optimizer(network, config)
    clock = Clock(config)
    if (out / INDEX).exists():
        resume(out, network, average, optimizer, clock)
    tiles = load_tiles(surfaces).to(device) if surfaces is not None else None
    maker = BatchMaker(load_shards(packs).to(device), config.batch, config.seed, tiles=tiles)
    step = make_step(network, config, device)
    running: dict[str, float] = {}
    skipped = torch.zeros((), device=device)
    first = clock.step
    begun = saved = last = time.monotonic() - seconds_since_start()
    while clock.done < 1:
        for group in optimizer.param_groups:
            group["lr"] = config.rate * group["share"] * clock.rate
        generator = torch.Generator(device=device)
        generator.manual_seed(config.seed * 7_919 + clock.step)
        batch = maker.make(clock.step)
        errors = step(batch, *states(batch, config, generator))
        skipped += clip(list(network.parameters()), config.clip)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        if config.compiled and clock.step - first == 15 and float(skipped) > 3:
            print(
                "The compiled network computes gradients that are not finite; going on without it.",
                flush=True,
            )
            step = make_step(network, replace(config, compiled=False), device)
            skipped = torch.zeros((), device=device)
        with torch.no_grad():
            share = max(1 / (clock.step + 2), min(0.05, clock_share(clock, first)))
            torch._foreach_lerp_(average, [weight.detach() for weight in network.parameters()], share)
        clock.step += 1
        if clock.step % 20 == 0 or device.type == "cpu":
            for name, error in errors.items():
                value = float(error)
                if math.isfinite(value):
                    running[name] = value if name not in running else 0.8 * running[name] + 0.2 * value
            running["skipped"] = float(skipped)
            if float(skipped) > 20 + 0.6 * (clock.step - first):
                raise InputError(
                    f"Training diverged at step {clock.step}: most gradients are not finite. Lower --rate."
                )
            if progress:
                progress(clock.step, clock.done, running)
        now = time.monotonic()
        if clock.step - first > 3:
            clock.spent += now - last
        else:  # the first steps compile
            clock.setup = now - begun
        last = now
        if now - saved > config.save_every or clock.done >= 1:
            store(out, network, average, optimizer, clock)
            saved = time.monotonic()


def seconds_since_start() -> float:
    """Return how long this process has run, as far as the system reports it."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
        return max(0.0, uptime - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return 0.0


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


def clock_share(clock: Clock, first: int) -> float:
    """Return the factor by which the average moves towards the weights in one step."""
    if clock.config.minutes is None:
        return 1 / (AVERAGED * clock.config.steps)
    steps = clock.step - first + 1
    total = max(steps / max(clock.done, 1e-3), 50.0)
    return 1 / (AVERAGED * total)


def make_optimizer(network: Lumen, config: FitConfig) -> torch.optim.Optimizer:
    """Return AdamW. Matrices decay, biases and scales do not, and the backbone's rate is smaller."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for name, weight in network.named_parameters():
        share = BACKBONE_RATE if name.startswith("scene.backbone") else 1.0
        decay = config.weight_decay if weight.ndim > 1 else 0.0
        groups.setdefault((share, decay), []).append(weight)
    rows = [
        {"params": weights, "share": share, "weight_decay": decay}
        for (share, decay), weights in groups.items()
    ]
    return torch.optim.AdamW(rows, lr=config.rate, betas=(0.9, 0.98), fused=True)


def states(batch: Batch, config: FitConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return flow times (B,) and states of x0: mostly pure noise, as in the first step of sampling."""
    count, device = len(batch.photo), batch.photo.device
    u = torch.rand(count, generator=generator, device=device)
    sigma = config.shift * u / (1 + (config.shift - 1) * u)
    alone = torch.rand(count, generator=generator, device=device) < config.one_step
    sigma = torch.where(alone, torch.ones_like(sigma), sigma.clamp(0.02, 1))
    noise = torch.randn(batch.truth.x0.shape, generator=generator, device=device)
    s = sigma[:, None, None, None]
    return (1 - s) * batch.truth.x0 + s * noise, sigma


Step = Callable[[Batch, Tensor, Tensor], dict[str, Tensor]]


def make_step(network: Lumen, config: FitConfig, device: torch.device) -> Step:
    """Return a function that computes the gradients of one batch and returns its errors."""
    half = config.precision == "bf16" or (config.precision == "auto" and has_bf16(device))

    def errors_of(batch: Batch, x: Tensor, sigma: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        photo = batch.photo.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            scene, completed, relit = network(x, sigma, photo, batch.strokes)
        return loss(scene, completed, relit.float(), batch)

    called = torch.compile(errors_of, dynamic=False) if config.compiled else errors_of

    def step(batch: Batch, x: Tensor, sigma: Tensor) -> dict[str, Tensor]:
        total, errors = called(batch, x, sigma)
        total.backward()
        return {"total": total.detach(), **errors}

    return step


def has_bf16(device: torch.device) -> bool:
    """Return whether matrix products in bf16 are faster there than in fp32."""
    if device.type == "cuda":
        return True
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return "amx_bf16" in flags or "avx512_bf16" in flags


# The state of a run: files of at most PART bytes, and an index.


def store(
    out: Path, network: Lumen, average: list[Tensor], optimizer: torch.optim.Optimizer, clock: Clock
) -> None:
    """Write the average in float16, then the weights and their moments."""
    names = [name for name, _ in network.named_parameters()]
    tensors: dict[str, Tensor] = {}
    for name, mean in zip(names, average, strict=True):
        tensors[name] = mean.half()
    write_parts(out, AVERAGE, tensors)
    state: dict[str, Tensor] = {}
    for (name, weight), _ in zip(network.named_parameters(), names, strict=True):
        state[f"weight.{name}"] = weight.detach()
        moments = optimizer.state[weight]
        state[f"first.{name}"], state[f"second.{name}"] = (
            moments["exp_avg"].bfloat16(),
            moments["exp_avg_sq"].bfloat16(),
        )
    write_parts(out, STATE, state)
    head = {"step": clock.step, "spent": clock.spent, "config": network.config.__dict__}
    with replacing(out / INDEX) as file:
        file.write(json.dumps(head).encode())


def resume(
    out: Path, network: Lumen, average: list[Tensor], optimizer: torch.optim.Optimizer, clock: Clock
) -> None:
    """Load what `store` wrote, on any device. Without the state's files, start from the average."""
    try:
        head = json.loads((out / INDEX).read_text())
        means, state = read_parts(out, AVERAGE), read_parts(out, STATE)
        with torch.no_grad():
            for (name, weight), mean in zip(network.named_parameters(), average, strict=True):
                mean.copy_(means[name])
                weight.copy_(state.get(f"weight.{name}", means[name]))
                if f"first.{name}" in state:
                    first, second = (
                        torch.empty_like(weight).copy_(state[f"{k}.{name}"]) for k in ("first", "second")
                    )
                    step = torch.tensor(float(head["step"]), device=weight.device)
                    optimizer.state[weight] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
        clock.step, clock.spent = int(head["step"]), float(head["spent"])
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise InputError(f"The run in {out} cannot go on: {reason(error)}.") from error
