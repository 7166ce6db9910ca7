"""The training loop for stage 1 from scratch, or for a LoRA on top of it. All backbones share one loop.

The loss is the squared error of x0, which for relighting is the squared error of the relit sRGB picture
(times 16) and for estimation that of the encoded Lumi map. In every sample, mini's estimate of the photo's
own light is compared with the truth, because drawn light is measured against it. Most samples are drawn at
sigma = 1, where the whole answer must come from the condition; the others at sigmas shifted towards it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, Literal

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.utils.data import DataLoader, IterableDataset

from dior_rt.errors import InputError
from dior_rt.files import make_folder
from dior_rt.flow.schedule import shift_sigma
from dior_rt.training.backbone import MiniLora
from dior_rt.training.data.triplets import GRIDS, Batches, Grids, load_views
from dior_rt.training.light import FLOOR, RELIT_SCALE, log_floored, srgb_to_linear
from dior_rt.training.network import BOUNCED, WEIGHTS, Config, Mini, load_network, save_network
from dior_rt.training.state import Average, State

STOPS: Final = 2.0  # drawn light is scaled by this factor to measure the response
LEAST_SIGMA: Final = 0.02  # smallest flow time that is sampled
STATE: Final = "state.safetensors"  # the state from which a run resumes

Progress = Callable[[int, float], None]  # step, running loss
Batch = dict[str, Tensor]
Prepare = Callable[[Batch], Batch]
Stream = Callable[[int, int], IterableDataset[Batch]]  # (number of the first batch, process) -> batches


@dataclass(frozen=True)
class Plan:
    """The options of training.

    The rate warms up, stays, and falls to 0 over the last fifth of the steps, so a longer plan can resume
    from any state before the fall. average: the half-life of the weights' average, in steps. clip: the
    largest norm of a gradient. shift, always_noise: parameters of flow times, see `draw_sigma`. noiseless:
    the share of samples whose noise is 0, as when sampling starts from the noise's mean. noise: the strength
    of the noise in the others. source_weight: the weight of the source light's error relative to that of x0.
    drawn: the additional weight of errors under strokes, where the light is known and visible to the user.
    edges: the weight of differences of the error between neighbouring cells. A visible outline where a stroke
    ends is small in error but conspicuous. response: the weight of `response_loss`, computed on a quarter of
    a batch. precision: a name of accelerate's. compiled: whether torch.compile is used, which takes minutes
    and then nearly halves a step's time on CPUs. grids: see `Batches`.
    """

    steps: int
    batch: int = 32
    rate: float = 8e-4
    warmup: int = 200
    decay: float = 0.2
    average: int = 300
    weight_decay: float = 0.02
    clip: float = 1.0
    shift: float = 8.0
    always_noise: float = 0.85
    noiseless: float = 0.7
    noise: float = 1.0
    source_weight: float = 0.25
    drawn: float = 0.0
    edges: float = 0.0
    response: float = 0.0
    seed: int = 0
    precision: Literal["no", "bf16"] = "no"
    compiled: bool = False
    grids: Grids = GRIDS
    save_every: int = 200

    def rate_at(self, step: int) -> float:
        falling = (self.steps - step) / max(self.decay * self.steps, 1)
        return self.rate * min(1.0, (step + 1) / self.warmup, max(falling, 0.0))


def fit(renders: Path, out: Path, start: Config | Path, plan: Plan, progress: Progress | None = None) -> None:
    """Train stage 1 on a folder of renders into the folder `out`. Resumes where it holds a state.

    start: the sizes of an untrained network, or the weights of a network to continue from. Raises InputError
    for renders, weights or a state that cannot be used, and where nothing can be written.
    """
    torch.manual_seed(plan.seed)
    network = Mini(start) if isinstance(start, Config) else load_network(start)
    # With channels-last convolutions, a step takes two thirds of the time on CPUs.
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # in place

    def save(network: nn.Module) -> None:
        assert isinstance(network, Mini)
        save_network(network, out / WEIGHTS)

    run(network, rendered(renders, plan), out, plan, progress, save)


def fit_lora(
    base: Path, renders: Path, out: Path, rank: int, plan: Plan, progress: Progress | None = None
) -> None:
    """Train a LoRA on the network at `base`. The folder `out` receives the base's weights and `lora/`.

    Resumes and raises like `fit`.
    """
    torch.manual_seed(plan.seed)
    backbone = MiniLora(base, rank, out)
    run(backbone.network, rendered(renders, plan), out, plan, progress, backbone.save)


def rendered(renders: Path, plan: Plan) -> Stream:
    """Return triplets from a folder of renders. Raises InputError where it holds none."""
    views = load_views(renders)
    return lambda start, rank: Batches(views, plan.batch, plan.seed, start, rank=rank, grids=plan.grids)


def flow_loss(
    network: nn.Module,
    batch: Batch,
    sigma: Tensor,
    noise: Tensor,
    source_weight: float = 0.0,
    drawn: float = 0.0,
    edges: float = 0.0,
) -> Tensor:
    """Return the mean squared error of x0 at flow times sigma (B,).

    The network sees (1 - sigma) x0 + sigma noise.

    A batch may carry `weight` (B,), the weight of each sample's error, and `own`, the light on the photo in
    the form of estimation's x0. The error of the network's estimate of it counts `source_weight` times as
    much as that of x0. Under the mask, squared errors count `drawn` times more; the weights of a sample have
    a mean of 1. The differences of x0's error between neighbouring cells, of pictures (B, C, h, w), count
    `edges` times.
    """
    s = sigma[:, None, None, None]
    x0 = batch["x0"]
    x = (1 - s) * x0 + s * noise
    inputs = {name: batch[name] for name in ("photo", "light", "mask", "mode")}
    asked = {"with_source": True} if "own" in batch else {}
    answer = network(x=x, sigma=sigma, **inputs, **asked)
    velocity, light = answer if asked else (answer, None)
    error = x - s * velocity - x0
    if drawn:
        weight = 1 + drawn * batch["mask"]
        errors = (weight * error.square()).flatten(1).mean(dim=1) / weight.flatten(1).mean(dim=1)  # (B,)
    else:
        errors = _mean_square(error)
    if edges:
        errors = errors + edges * (_mean_square(error.diff(dim=2)) + _mean_square(error.diff(dim=3)))
    if light is not None:
        errors = errors + source_weight * _mean_square(2 * light - 1 - batch["own"])
    return (errors * batch["weight"]).mean() if "weight" in batch else errors.mean()


def response_loss(network: nn.Module, batch: Batch, factor: Tensor) -> Tensor:
    """Return how far mini's light under strokes deviates from following their value.

    Drawn light times factor (B,) must give that much more light there, as far as the display shows it. The
    result is the mean squared error of the logarithm. The photo's own light does not depend on the strokes,
    so it is estimated once and reused.
    """
    photo, light, mask = batch["photo"], batch["light"], batch["mask"]
    x, sigma, mode = torch.zeros_like(photo), torch.ones_like(factor), torch.zeros_like(batch["mode"])
    times = factor[:, None, None, None]

    def lit(velocity: Tensor) -> Tensor:
        return log_floored(srgb_to_linear(photo - velocity.float() / RELIT_SCALE))

    inputs = {"x": x, "sigma": sigma, "photo": photo, "mask": mask, "mode": mode}
    with torch.no_grad():
        velocity, source = network(**inputs, light=light, with_source=True)
        before = lit(velocity)
    white = math.log1p(FLOOR)
    expected = before + torch.log((times * light + BOUNCED) / (light + BOUNCED))
    counted = mask * (before < 0)  # cells that are nearly clipped carry no information
    error = lit(network(**inputs, light=times * light, own=source)) - expected.clamp(max=white)
    return (counted * error.square()).sum() / counted.sum().clamp_min(1)


def _mean_square(error: Tensor) -> Tensor:
    return error.square().flatten(1).mean(dim=1)


def draw_sigma(count: int, plan: Plan, generator: torch.Generator) -> Tensor:
    """Return (count,) flow times: 1 for a share of the samples, else u -> s u / (1 + (s - 1) u) of a uniform
    u.
    """
    u = torch.rand(count, generator=generator)
    shifted = shift_sigma(u, plan.shift).clamp_min(LEAST_SIGMA)
    return torch.where(torch.rand(count, generator=generator) < plan.always_noise, torch.ones(count), shifted)


def draw_noise_strength(count: int, plan: Plan, generator: torch.Generator) -> Tensor:
    """Return (count, 1, 1, 1): 0 for the share of samples without noise, and the noise's strength for the
    others.
    """
    noisy = torch.rand(count, generator=generator) >= plan.noiseless
    return plan.noise * noisy.float()[:, None, None, None]


def run(
    network: nn.Module,
    stream: Stream,
    out: Path,
    plan: Plan,
    progress: Progress | None,
    save: Callable[[nn.Module], None],
    prepare: Prepare = lambda batch: batch,
) -> None:
    """Train to the plan's end. At intervals, `save` receives the network with its averaged weights.

    prepare: converts a batch of triplets to the network's data variable. Resumes where `out` holds a state.
    Raises InputError for a state that cannot be used, and where nothing can be written.
    """
    make_folder(out)
    accelerator = Accelerator(mixed_precision=plan.precision)
    trained = [weight for weight in network.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(
        trained, lr=plan.rate, betas=(0.9, 0.99), weight_decay=plan.weight_decay, fused=True
    )
    network, optimizer = accelerator.prepare(network.train(), optimizer)
    called: Any = torch.compile(network, dynamic=False) if plan.compiled else network
    state = State(trained, optimizer, Average(trained, plan.average))
    if (out / STATE).exists():
        state.resume(out / STATE)
    batches = stream(state.step, accelerator.process_index)
    # One process runs beside the training. Several would each draw the same batches.
    loader = DataLoader(batches, batch_size=None, num_workers=1, prefetch_factor=4)
    running = math.nan
    for batch in islice(_with_plain_errors(loader), max(plan.steps - state.step, 0)):
        moved = {name: value.to(accelerator.device) for name, value in batch.items()}
        with accelerator.autocast():
            prepared = prepare(moved)
        loss = _step(accelerator, called, state, prepared, plan)
        running = loss if math.isnan(running) else 0.98 * running + 0.02 * loss
        if progress:
            progress(state.step, running)
        if accelerator.is_main_process and (state.step % plan.save_every == 0 or state.step == plan.steps):
            with state.averaged():
                save(accelerator.unwrap_model(network))
            state.store(out / STATE)  # last: a run that was stopped in between saves its weights once more


def _with_plain_errors(batches: Iterable[Batch]) -> Iterator[Batch]:
    """Yield the batches. Reading errors of their process are reported without that process' traceback."""
    try:
        yield from batches
    except InputError as error:
        raise InputError(str(error).strip().rpartition("InputError: ")[2]) from error


def _step(accelerator: Accelerator, network: nn.Module, state: State, batch: Batch, plan: Plan) -> float:
    """Run one step of the optimiser and of the average, and return the loss."""
    for group in state.optimizer.param_groups:
        group["lr"] = plan.rate_at(state.step)
    seed = hash((plan.seed, accelerator.process_index, state.step)) % 2**63
    generator = torch.Generator().manual_seed(seed)  # on the host, so that a seed means the same everywhere
    sigma = draw_sigma(len(batch["x0"]), plan, generator).to(accelerator.device)
    noise = torch.randn(batch["x0"].shape, generator=generator).to(accelerator.device)
    noise *= draw_noise_strength(len(noise), plan, generator).to(accelerator.device)
    with accelerator.autocast():
        loss = flow_loss(network, batch, sigma, noise, plan.source_weight, plan.drawn, plan.edges)
        if plan.response:
            some = {name: value[: -(-len(sigma) // 4)] for name, value in batch.items()}
            stops = 2 * STOPS * torch.rand(len(some["x0"]), generator=generator) - STOPS
            loss = loss + plan.response * response_loss(network, some, torch.exp2(stops).to(sigma))
    accelerator.backward(loss)
    accelerator.clip_grad_norm_(state.weights, plan.clip)
    state.optimizer.step()
    state.optimizer.zero_grad()
    state.average.update(state.weights)
    state.step += 1
    return float(loss.detach())
