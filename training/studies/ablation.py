"""The ablation: compare representations of light, and training with and without stage 2, at one budget.

Each row trains from scratch with the same seed, views and kinds of pairs: stage 1 on renders, then a LoRA
by stage 2. Pictures that random cameras take of scenes that no row trains on stand in for real photos. The
last row's LoRA sees renders alone, so it differs from the first row only in the photos. Each row is judged
under control cut from its own representation, and under control cut from the Lumi map, because people draw
lamps and not their indirect effects.
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

TrainingProgress = Callable[[str, int, float], None]  # the name of the training, the step, the running loss

PAIRS: Final = ("replace", "change")  # of every held-out view
STILL: Final = ("keep",)  # pictures for the brush: nothing changes
GRID: Final = GridRule(cells=1024, multiple=4)
GRIDS: Final = ((32, 32), (28, 40), (40, 28))
SCHEDULE: Final = ShiftSchedule(Plan.shift)  # flow times as in training
EXAMPLES: Final = 3  # per row, for the contact sheet

LAMPS: Final = "strokes of the Lumi map"
AHEAD: Final = "PSNR minus the first row's"
CONTROL: Final = "The control is cut from the target's true map, either of the row's kind or the Lumi map."
BOUND: Final = "The quotient knows both true maps, of source and target."
BRUSH: Final = "White dabs at 0.25 to 4 times the light in a map."
DABS: Final = {"on its own map": None, "on the Lumi map": LUMI}  # the kind of map


@dataclass(frozen=True)
class Condition:
    """A row: its name, the kind of map for its control (see `maps`), and whether stage 2 sees photos."""

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
    """The budget of every row: a small network on grids of half the usual side.

    rank: of the LoRA. scenes: how many scenes stand in for real ones.
    """

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
    progress: TrainingProgress | None = None,
) -> tuple[Evaluation, list[Example]]:
    """Train every row into the folder `out` and judge it. Rows that are already trained are kept.

    maps, held_out: the output of `render_maps` for training and for judging. renders: the renders of
    `maps`; the other scenes in it stand in for photos. Raises InputError for unusable input.
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
    progress: TrainingProgress | None = None,
) -> Network:
    """Return a row's network after stage 1 and the LoRA. Rows of the same map share their stage 1."""
    stage1 = out / f"stage1-{row.kind}"
    lora = out / f"{'stage2' if row.stage2 else 'lora'}-{row.kind}"
    show_training = progress or (lambda training, step, loss: None)
    fit(views, stage1, budget.config, budget.stage1, partial(show_training, f"{row.kind}, stage 1"))
    show = partial(show_training, f"{row.kind}, {lora.name}")
    if row.stage2:
        make = partial(MiniLora, stage1 / WEIGHTS, budget.rank, lora)
        fit_stage2(make, views, photos, lora, budget.lora, progress=show)
    else:
        fit_lora(stage1 / WEIGHTS, views, lora, budget.rank, budget.lora, show)
    return Network.load(lora)


@dataclass(frozen=True)
class Walk:
    """How to walk the flow: the number of Euler steps and the strength of the noise; 0 leads to the mean."""

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
        """Load a base with its LoRA from a training folder."""
        base = load_network(folder / WEIGHTS)
        return Network(PeftModel.from_pretrained(base, str(folder / LORA)).eval())  # type: ignore[arg-type]

    def relight(self, photo: Photo, strokes: Strokes) -> Photo:
        """Return the photo (H, W, 3) under strokes of its size."""
        return OPS.transfer(photo, *self.light(photo, strokes))

    @torch.no_grad()
    def light(self, photo: Photo, strokes: Strokes) -> tuple[Raster, Raster]:
        """Return the photo on the light grid and the relit grid, (h, w, 3), linear."""
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


Scores = dict[str, list[float]]  # by measure, one per picture


def judge(networks: Mapping[Condition, Network], held_out: Path) -> tuple[Evaluation, list[Example]]:
    """Judge the rows on held-out views: the error to the truth, and the response to the brush.

    networks: the others are compared with the first row, per picture. The examples show each row under
    strokes. Raises InputError if the views of different maps show different pictures.
    """
    lamps = tasks(held_out, LUMI, PAIRS)
    copied = Row("copy", "", figures(score([task.source for task in lamps], lamps)), None)
    rows, bounds, brush, examples = [], [copied], [], []
    first: dict[str, Scores] = {}
    for row, network in networks.items():
        row_tasks = tasks(held_out, row.kind, PAIRS)
        check_same_pictures(row_tasks, lamps)
        for control, strokes in controls(row_tasks, lamps).items():
            relit = [
                network.relight(task.source, drawn) for task, drawn in zip(row_tasks, strokes, strict=True)
            ]
            scores = score(relit, row_tasks)
            ahead = np.subtract(scores["PSNR"], first.setdefault(control, scores)["PSNR"]).tolist()
            rows.append(Row(row.name, control, figures({**scores, AHEAD: ahead}), None))
            if control == "strokes":
                named = [replace(task, name=f"{task.name}, {row.name}") for task in row_tasks]
                examples += [Example(*each) for each in zip(named, strokes, relit, strict=True)][:EXAMPLES]
        if row.stage2:
            quotient_figures = figures(score(quotients(row_tasks), row_tasks))
            bounds.append(Row("quotient", f"both of kind {row.kind}", quotient_figures, None))
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
    """Return pairs of the views under a kind of map. Raises InputError if there are none."""
    found = benchmarks(held_out / kind, pairs, seed)
    if not found:
        raise InputError(f"There are no views in {held_out / kind}; make them with `dior-rt train maps`.")
    return [task for benchmark in found for task in benchmark]


def check_same_pictures(row_tasks: Sequence[Task], others: Sequence[Task]) -> None:
    """Raise InputError if tasks differ in more than their maps."""
    for one, other in zip(row_tasks, others, strict=True):
        same = one.name == other.name and np.array_equal(one.source, other.source)
        if not (same and np.array_equal(one.truth, other.truth)):
            raise InputError(f"The maps of {other.name} show different pictures; render the maps again.")


def controls(row_tasks: Sequence[Task], lamps: Sequence[Task]) -> dict[str, list[Strokes]]:
    """Return the control of a row by name: its full map, strokes cut from it, and strokes of the Lumi map."""
    drawn: dict[str, list[Strokes]] = {name: [task.control(name) for task in row_tasks] for name in DRAWN}
    return {**drawn, LAMPS: [task.control("strokes") for task in lamps]}


def score(pictures: Sequence[Photo], tasks: Sequence[Task]) -> Scores:
    """Return every measure of `eval` for each picture."""
    return {
        name: [measure(picture, task.truth) for picture, task in zip(pictures, tasks, strict=True)]
        for name, measure in MEASURES.items()
    }


def figures(scores: Scores) -> dict[str, Figure]:
    """Return the means with their intervals."""
    return {name: Figure.of(values) for name, values in scores.items()}


def quotients(tasks: Sequence[Task]) -> list[Photo]:
    """Return the quotients of the true maps, an oracle without learning."""
    pictures = []
    for task in tasks:
        assert task.source_lumi is not None and task.target_lumi is not None
        pictures.append(quotient(task.source, task.source_lumi, task.target_lumi))
    return pictures


def follow(network: Network, still: Sequence[Task]) -> Scores:
    """Return how the picture follows each white dab; see `control.Response`."""
    answers = [response(network.relight, [task]) for task in still]
    return {name: [getattr(answer, name) for answer in answers] for name in ("slope", "monotonic", "leakage")}
