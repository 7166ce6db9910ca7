"""The recipes: compare ways to train and sample mini, by short runs at equal cost.

Every row starts from the same seed, sees the same batches in the same order and spends as many floating-point
operations as `what ships`. So a larger network, or one that evaluates another, takes fewer steps. The rows
differ in the start of the flow, in what is trained before, or in the network's shape.

After a change of clock and scale, a flow from N(0, 1) to x0 and one from N(c, s^2) have the same states. So
a narrow prior, or an estimate as its mean, changes only the distribution of training draws and the inputs
of the network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import nn
from torch.utils.data import IterableDataset
from torch.utils.flop_counter import FlopCounterMode

from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.data.triplets import Batches, load_views
from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.benchmarks import renders as benchmarks
from dior_rt.training.evaluation.metrics import Photo, border_ratio, psnr
from dior_rt.training.evaluation.results import Evaluation, Example, Row, Table
from dior_rt.training.evaluation.tasks import DRAWN, Task
from dior_rt.training.fit import Batch, Plan, Progress, Stream, flow_loss, run
from dior_rt.training.network import WEIGHTS, Config, Mini, load_network, save_network
from dior_rt.training.studies.ablation import AHEAD, PAIRS, STILL, Budget, Network, Walk, figures, follow
from dior_rt.training.studies.variants import AboutEstimate, sever

EXAMPLES: Final = 2  # per row, for the contact sheet
CONTROL: Final = "The light is cut from the true Lumi map of the target."
BRUSH: Final = (
    "One step without noise. White dabs at 0.25 to 4 times the light that is there; borders: differences of "
    "the relit light across patch borders over those inside; control: what training cost."
)

ONCE: Final = Walk()


def walks(noise: float) -> tuple[Walk, ...]:
    """Return one step without noise, and several steps from noise.

    A single step is the same with noise, because at sigma = 1 the network ignores the state.
    """
    return ONCE, Walk(4, noise), Walk(20, noise)


@dataclass(frozen=True)
class Recipe:
    """A row.

    noiseless, always_noise, noise: as in `Plan`. share: its part of the cost.
    after: the recipe that is trained before and continued. about: `after` stays frozen, and the flow models
    the difference to its answer.
    patch, widen: the network's patch, and the factor of its width.
    blended: whether convolutions blend the transformer's answer across the borders of patches.
    walks: how its flow is sampled when it is judged.
    """

    name: str
    noiseless: float = Plan.noiseless
    always_noise: float = Plan.always_noise
    noise: float = Plan.noise
    share: float = 1.0
    after: Recipe | None = None
    about: bool = False
    patch: int = 4
    widen: int = 1
    blended: bool = True
    walks: tuple[Walk, ...] = (ONCE,)

    @property
    def folder(self) -> str:
        return self.name.replace(",", "").replace(" ", "-")

    def config(self, small: Config) -> Config:
        return replace(small, patch=self.patch, width=self.widen * small.width)


HALF: Final = Recipe("half a regression", noiseless=1, always_noise=1, share=0.5)
RECIPES: Final = (
    Recipe("what ships", walks=(*walks(1), Walk(20))),
    Recipe("noise start", noiseless=0, always_noise=0, walks=walks(1)),
    Recipe("noise start, sigma mostly 1", noiseless=0, walks=walks(1)),
    Recipe("regression", noiseless=1, always_noise=1),
    Recipe(
        "regression, then noise start", noiseless=0, always_noise=0, share=0.5, after=HALF, walks=walks(1)
    ),
    Recipe("bridge from the photo, noise 0.25", noiseless=0, always_noise=0, noise=0.25, walks=walks(0.25)),
    Recipe("bridge from the photo, no noise", noiseless=1, always_noise=0, walks=(ONCE, Walk(4), Walk(20))),
    Recipe(
        "estimate, then a flow about it",
        noiseless=0,
        always_noise=0,
        share=0.5,
        after=HALF,
        about=True,
        walks=walks(1),
    ),
    Recipe("what ships, patch 8", patch=8),
    Recipe("what ships, twice as wide", widen=2),
    Recipe("what ships, patches not blended", blended=False),
)

SMALL: Final = Budget().config
PLAN: Final = replace(Budget().stage1, grids=((32, 32),))


def study(
    renders: Path,
    held_out: Path,
    out: Path,
    plan: Plan = PLAN,
    small: Config = SMALL,
    recipes: Sequence[Recipe] = RECIPES,
    progress: Progress | None = None,
) -> tuple[Evaluation, list[Example]]:
    """Train every row into the folder `out` and judge it on held-out views. Trained rows are kept.

    plan: of the first row; the other rows differ in steps and noise. progress: called with the steps of all
    rows. Raises InputError for unusable input.
    """
    tasks, still = pairs(held_out, PAIRS, seed=1), pairs(held_out, STILL, seed=3)
    batches = Shared(iter(Batches(load_views(renders), plan.batch, plan.seed, grids=plan.grids)))
    plans = at_equal_cost(plan, small, recipes)
    trained: dict[Recipe, nn.Module] = {}
    before = 0  # steps of the rows before this one
    for recipe, row_plan in plans.items():
        show = None if progress is None else partial(_show_total, progress, before)
        trained[recipe] = train(recipe, row_plan, small, trained, batches.after(plans, recipe), out, show)
        before += row_plan.steps
    rows = {recipe: trained[recipe] for recipe in recipes}
    costs = {recipe: cost(recipe, plans, small) for recipe in recipes}
    return judge(rows, costs, tasks, still)


def total_steps(plan: Plan = PLAN, small: Config = SMALL, recipes: Sequence[Recipe] = RECIPES) -> int:
    """Return the steps of all rows and of the recipes trained before them."""
    return sum(row_plan.steps for row_plan in at_equal_cost(plan, small, recipes).values())


def _show_total(progress: Progress, before: int, step: int, loss: float) -> None:
    progress(before + step, loss)


def pairs(held_out: Path, kinds: Sequence[str], seed: int) -> list[Task]:
    """Return pairs of the views. Raises InputError if there are none."""
    found = benchmarks(held_out, kinds, seed)
    if not found:
        raise InputError(
            f"There are no renders in {held_out}; make some with `dior-rt train render --out {held_out}`."
        )
    return [task for benchmark in found for task in benchmark]


def at_equal_cost(plan: Plan, small: Config, recipes: Sequence[Recipe]) -> dict[Recipe, Plan]:
    """Return the plan of each recipe, in the order of training, such that all rows cost the same."""
    ordered = dict.fromkeys(each for recipe in recipes for each in (recipe.after, recipe) if each)
    whole = plan.steps * step_cost(Mini(small), plan)
    return {
        recipe: replace(
            plan,
            steps=max(round(recipe.share * whole / step_cost(_blank(recipe, small), plan)), 1),
            noiseless=recipe.noiseless,
            always_noise=recipe.always_noise,
            noise=recipe.noise,
        )
        for recipe in ordered
    }


def step_cost(network: nn.Module, plan: Plan) -> int:
    """Return the operations of a training step's products and convolutions, forward and backward."""
    count, (height, width) = plan.batch, plan.grids[0]
    planes = torch.zeros(count, 3, height, width)
    batch = {name: planes for name in ("photo", "light", "x0", "own")}
    batch |= {"mask": planes[:, :1], "mode": torch.zeros(count, dtype=torch.int64)}
    with FlopCounterMode(display=False) as counted:
        flow_loss(network, batch, torch.ones(count), planes, plan.source_weight).backward()
    return int(counted.get_total_flops())


def cost(recipe: Recipe, plans: Mapping[Recipe, Plan], small: Config) -> Cost:
    """Return the cost of a row, including the recipe trained before it."""
    row_plan, network = plans[recipe], _blank(recipe, small)
    earlier = cost(recipe.after, plans, small) if recipe.after else Cost(0, 0, 0)
    weights = sum(weight.numel() for weight in network.parameters())
    flops = row_plan.steps * step_cost(network, row_plan)
    return Cost(earlier.samples + row_plan.steps * row_plan.batch, weights, earlier.flops + flops)


@dataclass(frozen=True)
class Cost:
    """weights: of all networks that an answer needs. flops: operations of training."""

    samples: int
    weights: int
    flops: int

    def __str__(self) -> str:
        return f"{self.samples} samples, {self.weights / 1e6:.2f} M weights, {self.flops / 1e12:.2f} TFLOP"


class Shared:
    """Batches that are drawn once and shared by all rows."""

    def __init__(self, source: Iterator[Batch]) -> None:
        self.source, self.drawn = source, list[Batch]()

    def after(self, plans: Mapping[Recipe, Plan], recipe: Recipe) -> Stream:
        """Return a row's batches, which begin where those of the recipe before it end."""
        first = plans[recipe.after].steps if recipe.after else 0
        end = first + plans[recipe].steps

        def stream(start: int, rank: int) -> IterableDataset[Batch]:
            missing = end - len(self.drawn) if first + start < end else 0
            self.drawn.extend(islice(self.source, max(missing, 0)))
            return Drawn(self.drawn[first + start : end])

        return stream


class Drawn(IterableDataset[Batch]):
    """Batches as a data set."""

    def __init__(self, batches: Sequence[Batch]) -> None:
        super().__init__()
        self.batches = batches

    def __iter__(self) -> Iterator[Batch]:
        return iter(self.batches)


def train(
    recipe: Recipe,
    plan: Plan,
    small: Config,
    trained: Mapping[Recipe, nn.Module],
    stream: Stream,
    out: Path,
    progress: Progress | None,
) -> nn.Module:
    """Return a recipe's network with averaged weights. trained: the networks it may continue."""
    torch.manual_seed(plan.seed)
    folder, base = out / recipe.folder, trained[recipe.after] if recipe.after else None
    network = _network(recipe, small, base)

    def save(network: nn.Module) -> None:
        flow = network.flow if isinstance(network, AboutEstimate) else network
        assert isinstance(flow, Mini)
        save_network(flow, folder / WEIGHTS)

    run(network, stream, folder, plan, progress, save)
    flow = load_network(folder / WEIGHTS)
    return AboutEstimate(base, flow) if recipe.about and base else flow


def _network(recipe: Recipe, small: Config, base: nn.Module | None) -> nn.Module:
    """Return the network with which a recipe's training begins."""
    network = deepcopy(base) if base else Mini(recipe.config(small))
    if not recipe.blended:
        assert isinstance(network, Mini)
        sever(network)
    return AboutEstimate(base, network) if recipe.about and base else network


def _blank(recipe: Recipe, small: Config) -> nn.Module:
    """Return a new network of the recipe's shape."""
    return _network(recipe, small, Mini(recipe.config(small)) if recipe.after else None)


def judge(
    networks: Mapping[Recipe, nn.Module],
    costs: Mapping[Recipe, Cost],
    tasks: Sequence[Task],
    still: Sequence[Task],
) -> tuple[Evaluation, list[Example]]:
    """Judge the rows on pairs of held-out views, and with the brush on views that keep their light.

    All rows are compared with the first row in one step, per picture. The examples show each row under
    strokes in one step.
    """
    strokes = {drawn: [task.control(drawn) for task in tasks] for drawn in DRAWN}
    first: dict[str, list[float]] = {}
    rows, brush, examples = [], [], []

    def add(name: str, drawn: str, how: str, relit: Sequence[Photo]) -> None:
        scores = [psnr(picture, task.truth) for picture, task in zip(relit, tasks, strict=True)]
        ahead = np.subtract(scores, first.setdefault(drawn, scores)).tolist()
        rows.append(Row(name, f"{drawn}, {how}", figures({"PSNR": scores, AHEAD: ahead}), None))

    for recipe, network in networks.items():
        for walk in recipe.walks:
            for drawn, control in strokes.items():
                relit = answers(network, walk, tasks, control)
                add(recipe.name, drawn, named(walk), relit)
                if walk == ONCE and drawn == "strokes":
                    titled = [replace(task, name=f"{task.name}, {recipe.name}") for task in tasks]
                    examples += [Example(*each) for each in zip(titled, control, relit, strict=True)][
                        :EXAMPLES
                    ]
        blocks = [
            borders(network, recipe.patch, *each) for each in zip(tasks, strokes["strokes"], strict=True)
        ]
        followed = figures({**follow(Network(network), still), "borders": blocks})
        brush.append(Row(recipe.name, str(costs[recipe]), followed, None))
    for drawn in DRAWN:
        add("copy", drawn, "no network", [task.source for task in tasks])
    heading = f"{len(still)} held-out views: all lights replaced; one light changed"
    tables = (
        Table(heading, len(tasks), CONTROL, tuple(rows), None),
        Table("The brush, blocks and cost", len(still), BRUSH, tuple(brush), None),
    )
    return Evaluation("recipes", None, tables), examples


def answers(network: nn.Module, walk: Walk, tasks: Sequence[Task], strokes: Sequence[Strokes]) -> list[Photo]:
    """Relight every task's source under its strokes. Each task has its own noise, the same for all rows."""
    return [
        Network(network, replace(walk, seed=task.seed)).relight(task.source, drawn)
        for task, drawn in zip(tasks, strokes, strict=True)
    ]


def borders(network: nn.Module, patch: int, task: Task, strokes: Strokes) -> float:
    """Return `border_ratio` of the light that a picture gains under strokes."""
    source, relit = Network(network).light(task.source, strokes)
    return border_ratio(np.log((relit + E) / (source + E)), patch)


def named(walk: Walk) -> str:
    """Describe a walk in words."""
    steps = f"{walk.steps} step{'s' if walk.steps > 1 else ''}"
    return f"{steps} from noise {walk.noise:g}" if walk.noise else f"{steps} without noise"
