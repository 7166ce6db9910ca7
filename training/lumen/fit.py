"""The training loop on one device, planned by time or by steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from dior_rt.errors import InputError
from dior_rt.files import make_folder
from dior_rt.training.lumen.backbone import load_imagenet
from dior_rt.training.lumen.batches import Batch, BatchMaker
from dior_rt.training.lumen.checkpoint import INDEX, load_lumen
from dior_rt.training.lumen.clock import Clock
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.loss import loss
from dior_rt.training.lumen.materials import load_tiles
from dior_rt.training.lumen.model import Lumen
from dior_rt.training.lumen.pack import load_shards
from dior_rt.training.lumen.run import Run

SIZES: Final = LumenConfig()
TRIED: Final = 15  # steps after which a compiled network must have had finite gradients
SHOWN: Final = 20  # steps between two looks at the errors on a GPU, because a look waits for it

Progress = Callable[[int, float, dict[str, float]], None]  # step, share done, running errors
Step = Callable[[Batch, Tensor, Tensor], dict[str, Tensor]]


@dataclass(frozen=True)
class FitConfig:
    """The options of training.

    minutes: of training, loading and compiling included; None: `steps` decide.
    steps: of the optimiser, where minutes is None.
    batch: samples a step.
    rate: AdamW's largest learning rate.
    weight_decay: of matrices.
    clip: largest norm of a gradient.
    one_step: share of samples without any state, as the first step of sampling sees it.
    shift: of the other samples' flow times; above 1, more of them lie near noise.
    seed: of the samples.
    precision: "bf16", "fp32", or "auto": bf16 where the hardware multiplies in it.
    compiled: by torch.compile.
    save_every: seconds between two checkpoints.
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
    """Train on the shards in `packs`. The folder `out` receives the state in parts, and training resumes from
    it.

    sizes: of a new network. start: the checkpoint of another run to continue from instead, with a new
    schedule. backbone: ImageNet weights for the features. surfaces: a folder of surface sheets, for new
    materials. Raises InputError for files that cannot be used, and where training diverges.
    """
    views = load_shards(packs)
    make_folder(out)
    device = prepare_device()
    torch.manual_seed(config.seed)
    network = load_lumen(start).train() if start is not None else Lumen(sizes)
    if backbone is not None:
        load_imagenet(network.scene.backbone, backbone)
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    run = Run.begin(network, Clock(config.steps, config.minutes), config.rate, config.weight_decay)
    if (out / INDEX).exists():
        run.resume(out)
    tiles = load_tiles(surfaces).to(device) if surfaces is not None else None
    maker = BatchMaker(views.to(device), config.batch, config.seed, tiles=tiles)
    step, watch = make_step(network, config, device), Watch(device)
    while run.clock.done < 1:
        batch = maker.make(run.clock.step)
        errors = step(batch, *states(batch, config, run.clock.step))
        watch.skipped += run.advance(config.clip)
        if config.compiled and run.clock.taken == TRIED and float(watch.skipped) > TRIED / 3:
            step, watch = make_step(network, replace(config, compiled=False), device), Watch(device)
        if run.clock.step % SHOWN == 0 or device.type == "cpu":
            watch.look(errors, run.clock)
            if progress:
                progress(run.clock.step, run.clock.done, watch.running)
        if run.clock.done >= 1 or time.monotonic() - watch.saved > config.save_every:
            run.store(out)
            watch.saved = time.monotonic()


@dataclass
class Watch:
    """Running means of the errors, the number of steps without a finite gradient, and the time of the last
    save.
    """

    device: torch.device
    running: dict[str, float] = field(default_factory=dict)
    skipped: Tensor = field(init=False)
    saved: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.skipped = torch.zeros((), device=self.device)

    def look(self, errors: dict[str, Tensor], clock: Clock) -> None:
        """Add a step's errors. Raises InputError where most gradients are not finite."""
        for name, error in errors.items():
            value = float(error)
            if math.isfinite(value):
                self.running[name] = 0.8 * self.running.get(name, value) + 0.2 * value
        self.running["skipped"] = float(self.skipped)
        if self.running["skipped"] > 2 * TRIED + 0.5 * clock.taken:
            raise InputError(
                f"Training diverged at step {clock.step}: most gradients are not finite. Lower --rate."
            )


def prepare_device() -> torch.device:
    """Return the GPU, where there is one, else the CPU; matrix products may use TF32."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def states(batch: Batch, config: FitConfig, number: int) -> tuple[Tensor, Tensor]:
    """Return states of x0 and their flow times (B,). Most are pure noise, where sampling starts."""
    count, device = len(batch.photo), batch.photo.device
    generator = torch.Generator(device=device).manual_seed(config.seed * 7_919 + number)
    u = torch.rand(count, generator=generator, device=device)
    sigma = config.shift * u / (1 + (config.shift - 1) * u)
    alone = torch.rand(count, generator=generator, device=device) < config.one_step
    sigma = torch.where(alone, torch.ones_like(sigma), sigma.clamp(0.02, 1))
    noise = torch.randn(batch.truth.x0.shape, generator=generator, device=device)
    s = sigma[:, None, None, None]
    return (1 - s) * batch.truth.x0 + s * noise, sigma


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
