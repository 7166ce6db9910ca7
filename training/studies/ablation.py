"""The ablation: what the Lumi map, and stage 2, are worth. One row a representation of light, one budget.

Each row learns from nothing, from the same seed, views and kinds of pairs: stage 1 on renders, then a LoRA
by stage 2. Real photos are stood in for by pictures that random cameras take of scenes that no row trains on.
The last row's LoRA sees renders alone, so it differs from the first in nothing but the photos. The control
that a row is judged under is of its own representation, and also of the Lumi map: what a person draws who
thinks of lamps, and of nothing that they do to one another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from peft import PeftModel
from torch import Tensor, nn

from dior_rt.errors import InputError
from dior_rt.families import mini
from dior_rt.flow.sampler import draw_noise, sample
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.grid import GridRule
from dior_rt.kernels import Strokes
from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear
from dior_rt.light import relit_from_x0
from dior_rt.training.backbone import MiniLora
from dior_rt.training.data.maps import LUMI
from dior_rt.training.data.photos import take_photos
from dior_rt.training.evaluation.baselines import quotient
from dior_rt.training.evaluation.benchmarks import renders as benchmarks
from dior_rt.training.evaluation.control import response
from dior_rt.training.evaluation.metrics import Photo, Raster
from dior_rt.training.evaluation.results import Evaluation, Example, Figure, Row, Table
from dior_rt.training.evaluation.run import MEASURES
from dior_rt.training.evaluation.tasks import DRAWN, OPS, Task
from dior_rt.training.fit import Plan, fit, fit_lora
from dior_rt.training.network import LORA, WEIGHTS, Config, load_network
from dior_rt.training.stage2 import Scene, fit_stage2, load_scenes

Told = Callable[[str, int, float], None]  # which training, step, running loss

PAIRS: Final = ("replace", "change")  # of every held-out view
STILL: Final = ("keep",)  # what the brush visits: pictures under their own light
GRID: Final = GridRule(cells=1024, multiple=4)
GRIDS: Final = ((32, 32), (28, 40), (40, 28))
SCHEDULE: Final = ShiftSchedule(Plan.shift)  # as flow times are drawn in training
EXAMPLES: Final = 3  # of a row, for the contact sheet

LAMPS: Final = "strokes of the Lumi map"
AHEAD: Final = "PSNR less the first row's"
CONTROL: Final = "The light is cut from the true map of the target, of the row's kind or the Lumi map."
BOUND: Final = "The quotient knows both true maps, of source and target."
BRUSH: Final = "White dabs at 0.25 to 4 times the light that a map says is there."
DABS: Final = {"on its own map": None, "on the Lumi map": LUMI}  # of which kind


@dataclass(frozen=True)
class Condition:
    """A row: its name, the kind of map (see `maps`) that is its control, and whether stage 2 sees photos."""

    name: str
    kind: str
    stage2: bool = True


CONDITIONS: Final = (
    Condition("Lumi map", LUMI),
    Condition("irradiance", "irradiance"),
    Condition("shading", "shading"),
    Condition("Phong map", "phong"),
    Condition("Lumi map, without stage 2", LUMI, stage2=False),
)


@dataclass(frozen=True)
class Budget:
    """What every row may spend: a small network, for grids of half the usual side. rank: of the LoRA.
    scenes: how many stand in for real ones."""

    config: Config = field(default_factory=lambda: Config(96, 3, 4, patch=4, fine=8, half=32, quarter=64))
    stage1: Plan = field(default_factory=lambda: Plan(steps=400, batch=8, warmup=30, average=30, grids=GRIDS))
    lora: Plan = field(
        default_factory=lambda: Plan(steps=80, batch=8, rate=1e-3, warmup=10, average=15, seed=1, grids=GRIDS)
    )
    rank: int = 16
    scenes: int = 60


def ablate(
    maps: Path,
    held_out: Path,
    renders: Path,
    out: Path,
    budget: Budget = Budget(),
    progress: Told | None = None,
) -> tuple[Evaluation, list[Example]]:
    """Train every row into the folder `out` and judge it; what is trained already is kept.

    maps, held_out: what `render_maps` made of renders to train on and of others. renders: what `maps` was
    made of; its other scenes stand in for photos. Raises InputError for what cannot be used.
    """
    photos = load_scenes(take_photos(renders, out / "photos", without=maps / LUMI, scenes=budget.scenes))
    networks = {row: train(row, maps / row.kind, photos, out, budget, progress) for row in CONDITIONS}
    return judge(networks, held_out)


def train(
    row: Condition,
    views: Path,
    photos: list[Scene],
    out: Path,
    budget: Budget,
    progress: Told | None = None,
) -> Network:
    """A row's network, stage 1 and LoRA. Rows of the same map share their stage 1."""
    stage1 = out / f"stage1-{row.kind}"
    lora = out / f"{'stage2' if row.stage2 else 'lora'}-{row.kind}"
    tell = progress or (lambda training, step, loss: None)
    fit(views, stage1, budget.config, budget.stage1, partial(tell, f"{row.kind}, stage 1"))
    show = partial(tell, f"{row.kind}, {lora.name}")
    if row.stage2:
        make = partial(MiniLora, stage1 / WEIGHTS, budget.rank, lora)
        fit_stage2(make, views, photos, lora, budget.lora, progress=show)
    else:
        fit_lora(stage1 / WEIGHTS, views, lora, budget.rank, budget.lora, show)
    return Network.load(lora)


@dataclass(frozen=True)
class Walk:
    """How the flow is walked: by Euler's steps, from noise of a strength; from none to the mean answer."""

    steps: int = 1
    noise: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Network:
    """A network in torch that relights as the runtime does."""

    network: nn.Module
    walk: Walk = Walk()

    @staticmethod
    def load(folder: Path) -> Network:
        """A base with its LoRA, as training leaves them."""
        base = load_network(folder / WEIGHTS)
        return Network(PeftModel.from_pretrained(base, str(folder / LORA)).eval())  # type: ignore[arg-type]

    def relight(self, photo: Photo, strokes: Strokes) -> Photo:
        """The photo (H, W, 3) under strokes of its size."""
        return OPS.transfer(photo, *self.light(photo, strokes))

    @torch.no_grad()
    def light(self, photo: Photo, strokes: Strokes) -> tuple[Raster, Raster]:
        """The photo on the light grid, and relit; (h, w, 3), linear."""
        grid = GRID.shape(*photo.shape[:2])
        source = OPS.reduce_photo(photo, grid)
        encoded = np.clip(linear_to_srgb(source), 0, 1).astype(np.float32)
        drawn = OPS.reduce_strokes(strokes.light, strokes.mask, grid)
        condition = mini.encode(encoded, drawn, "relight")
        inputs: dict[str, Tensor] = {name: torch.from_numpy(value) for name, value in condition.items()}

        def velocity(x: Raster, sigma: float) -> Raster:
            return self.network(x=torch.from_numpy(x), sigma=torch.tensor([sigma]), **inputs).numpy()

        noise = np.float32(self.walk.noise) * draw_noise(self.walk.seed, condition["photo"].shape)
        *_, end = sample(velocity, noise, SCHEDULE.sigmas(self.walk.steps))
        relit = relit_from_x0(end.x, condition["photo"])[0].transpose(1, 2, 0)
        return source, srgb_to_linear(np.ascontiguousarray(relit)).astype(np.float32)


Scores = dict[str, list[float]]  # by measure, one a picture


def judge(networks: Mapping[Condition, Network], held_out: Path) -> tuple[Evaluation, list[Example]]:
    """The rows over held-out views: how near the truth they come, and how they follow the brush.

    networks: what the first row scores, the others are compared with, picture by picture. The examples are
    of each row's strokes. Raises InputError where the views of different maps are not of the same pictures.
    """
    lamps = tasks(held_out, LUMI, PAIRS)
    copied = Row("copy", "", figures(score([task.source for task in lamps], lamps)), None)
    rows, bounds, brush, examples = [], [copied], [], []
    first: dict[str, Scores] = {}
    for row, network in networks.items():
        own = tasks(held_out, row.kind, PAIRS)
        check_same_pictures(own, lamps)
        for control, strokes in controls(own, lamps).items():
            relit = [network.relight(task.source, drawn) for task, drawn in zip(own, strokes, strict=True)]
            scores = score(relit, own)
            ahead = np.subtract(scores["PSNR"], first.setdefault(control, scores)["PSNR"]).tolist()
            rows.append(Row(row.name, control, figures({**scores, AHEAD: ahead}), None))
            if control == "strokes":
                named = [replace(task, name=f"{task.name}, {row.name}") for task in own]
                examples += [Example(*each) for each in zip(named, strokes, relit, strict=True)][:EXAMPLES]
        if row.stage2:
            known = figures(score(quotients(own), own))
            bounds.append(Row("quotient", f"both of kind {row.kind}", known, None))
        for control, kind in DABS.items():
            still = tasks(held_out, kind or row.kind, STILL, seed=3)
            brush.append(Row(row.name, control, figures(follow(network, still)), None))
    heading = f"{len(lamps) // len(PAIRS)} held-out views: all lights replaced; one light changed"
    tables = (
        Table(heading, len(lamps), CONTROL, tuple(rows), None),
        Table("The same without a network", len(lamps), BOUND, tuple(bounds), None),
        Table("The brush", len(lamps) // len(PAIRS), BRUSH, tuple(brush), None),
    )
    return Evaluation("ablation", None, tables), examples


def tasks(held_out: Path, kind: str, pairs: Sequence[str], seed: int = 1) -> list[Task]:
    """Pairs of the views under a kind of map. Raises InputError where there are none."""
    found = benchmarks(held_out / kind, pairs, seed)
    if not found:
        raise InputError(f"There are no views in {held_out / kind}; make them with `dior-rt train maps`.")
    return [task for benchmark in found for task in benchmark]


def check_same_pictures(own: Sequence[Task], others: Sequence[Task]) -> None:
    """Raise InputError where tasks differ in more than their maps."""
    for one, other in zip(own, others, strict=True):
        same = one.name == other.name and np.array_equal(one.source, other.source)
        if not (same and np.array_equal(one.truth, other.truth)):
            raise InputError(f"The maps of {other.name} are not of the same pictures; render them anew.")


def controls(own: Sequence[Task], lamps: Sequence[Task]) -> dict[str, list[Strokes]]:
    """What drives a row, by name: its own map whole, strokes cut out of it, and out of the Lumi map."""
    drawn: dict[str, list[Strokes]] = {name: [task.control(name) for task in own] for name in DRAWN}
    return {**drawn, LAMPS: [task.control("strokes") for task in lamps]}


def score(pictures: Sequence[Photo], tasks: Sequence[Task]) -> Scores:
    """Every measure of `eval`, picture by picture."""
    return {
        name: [measure(picture, task.truth) for picture, task in zip(pictures, tasks, strict=True)]
        for name, measure in MEASURES.items()
    }


def figures(scores: Scores) -> dict[str, Figure]:
    """Means and their intervals."""
    return {name: Figure.of(values) for name, values in scores.items()}


def quotients(tasks: Sequence[Task]) -> list[Photo]:
    """What both true maps say of the pictures, with nothing learnt."""
    pictures = []
    for task in tasks:
        assert task.source_lumi is not None and task.target_lumi is not None
        pictures.append(quotient(task.source, task.source_lumi, task.target_lumi))
    return pictures


def follow(network: Network, still: Sequence[Task]) -> Scores:
    """How the picture follows a white dab, dab by dab; see `control.Response`."""
    answers = [response(network.relight, [task]) for task in still]
    return {name: [getattr(answer, name) for answer in answers] for name in ("slope", "monotonic", "leakage")}
