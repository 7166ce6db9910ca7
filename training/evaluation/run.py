"""Run a method on a benchmark, and score every picture beside the baselines."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.evaluation import control
from dior_rt.training.evaluation.baselines import gain, match, quotient
from dior_rt.training.evaluation.benchmarks import open_benchmarks, renders
from dior_rt.training.evaluation.judges.models import Blur, BundleModel, Glow
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.lpips import BACKBONES, Lpips
from dior_rt.training.evaluation.methods import Model, Pictures, Settings, open_method
from dior_rt.training.evaluation.metrics import Photo, psnr, rmse, scale_invariant_psnr, scaled_psnr, ssim
from dior_rt.training.evaluation.results import Control, Evaluation, Example, Figure, Row, Table
from dior_rt.training.evaluation.tasks import DRAWN, OPS, Benchmark, Task

Measure = Callable[[Photo, Photo], float]
MEASURES: Final[Mapping[str, Measure]] = {
    "PSNR": psnr,
    "SI-PSNR": scale_invariant_psnr,
    "RMSE": rmse,
    "SSIM": ssim,
}
EXAMPLES: Final = 8  # per benchmark, for the contact sheet
SECONDS: Final = "seconds"
PHOTOS: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")

TRUE_CONTROL: Final = "The light is cut from the true Lumi map of the target."
ESTIMATED_CONTROL: Final = (
    "No true map is known: the light is estimated from the target by the same model, and drives the source."
)


@dataclass(frozen=True)
class Answer:
    """One picture for one task."""

    method: str
    control: str
    picture: Photo
    seconds: float | None = None
    strokes: Strokes | None = None


@dataclass(frozen=True)
class Plan:
    """What to measure.

    views: the most pairs of each kind. dabs: how many views of renders the brush visits. lpips: whether to
    measure it.
    photos: a folder of pictures in which to measure patch borders.
    """

    views: int = 80
    dabs: int = 10
    lpips: bool = False
    photos: Path | None = None


def evaluate(
    folder: Path, benchmark: Path, settings: Settings, plan: Plan
) -> tuple[Evaluation, list[Example]]:
    """Evaluate a bundle with settings, or the pictures of another method. Raises the errors of reading."""
    benchmarks = open_benchmarks(benchmark)  # before anything slow is loaded
    method = open_method(folder, settings)
    measures = dict(MEASURES)
    if plan.lpips:
        measures |= {f"LPIPS {name}": Lpips(name) for name in BACKBONES}
    photos = list_photos(plan.photos) if plan.photos else []
    results = [run(method, found.first(plan.views), measures) for found in benchmarks]
    tables = tuple(table for table, _ in results)
    examples = [example for _, shown in results for example in shown]
    if isinstance(method, Pictures):
        return Evaluation(method.name, None, tables), examples
    brush = run_control(method, benchmark, plan.views, plan.dabs)
    seams = run_borders(method, photos) if photos else None
    return Evaluation(method.name, method.settings, tables, brush, seams), examples


def run(
    method: Model | Pictures, benchmark: Benchmark, measures: Mapping[str, Measure] = MEASURES
) -> tuple[Table, list[Example]]:
    """Return the table of one benchmark and its first EXAMPLES. Only one task is in memory at a time."""
    scores: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    estimates: list[float] = []
    examples: list[Example] = []
    for task in benchmark:
        estimated = _estimated(method, task) if isinstance(method, Model) else None
        if estimated and task.source_lumi is not None:
            estimates.append(_estimate_psnr(estimated, task))
        for answer in _answers(method, task, estimated):
            figures = {name: measure(answer.picture, task.truth) for name, measure in measures.items()}
            if answer.seconds is not None:
                figures[SECONDS] = answer.seconds
            scores[answer.method, answer.control].append(figures)
        if len(examples) < EXAMPLES:
            examples.append(Example(task, answer.strokes, answer.picture))  # of the method
    rows = tuple(_row(*key, figures) for key, figures in scores.items())
    light = TRUE_CONTROL if benchmark.true_maps else ESTIMATED_CONTROL
    estimate = Figure.of(estimates) if estimates else None
    return Table(benchmark.name, len(benchmark), light, rows, estimate), examples


def run_control(model: Model, folder: Path, views: int, dabs: int) -> Control | None:
    """Measure the response to the brush on `dabs` views. Return None without renders."""
    if not dabs or not renders(folder):
        return None
    still, changed, kept, added = (
        renders(folder, (kind,), seed)[0].first(count)
        for kind, seed, count in (
            ("keep", 3, dabs),
            ("change", 1, dabs),
            ("keep", 2, views),
            ("add", 4, views),
        )
    )
    return Control(
        control.response(model.relight, still),
        control.chroma(model.relight, still),
        control.progress(model.relight, changed),
        control.keep_psnr(model.relight, kept),
        control.keep_psnr(model.relight, added),
    )


def run_borders(model: Model, photos: Sequence[Path]) -> control.Borders:
    """Measure patch borders on photos. Raises InputError if the model has no light grid."""
    if model.grid is None:
        raise InputError(f"{model.name} predicts no light grid, so it has no patch borders to measure.")
    return control.borders(model.relight, model.estimate, model.grid, map(read_picture, photos))


def list_photos(folder: Path) -> list[Path]:
    """Return the pictures of a folder. Raises InputError if there are none."""
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in PHOTOS)
    if not paths:
        raise InputError(f"There are no pictures in {folder}.")
    return paths


def _row(method: str, drawn: str, scored: list[dict[str, float]]) -> Row:
    seconds = [figures.pop(SECONDS) for figures in scored if SECONDS in figures]
    figures = {name: Figure.of([one[name] for one in scored]) for name in scored[0]}
    return Row(method, drawn, figures, float(np.mean(seconds)) if seconds else None)


def _answers(method: Model | Pictures, task: Task, estimated: Task | None) -> Iterator[Answer]:
    """Yield the answers of the baselines, then those of the method."""
    yield Answer("copy", "", task.source)
    yield Answer("gain", "target's colours", gain(task.source, task.truth))
    yield Answer("mean and deviation", "target's colours", match(task.source, task.truth))
    for maps, lit_task in (("true maps", task), ("estimated maps", estimated)):
        if lit_task and lit_task.source_lumi is not None and lit_task.target_lumi is not None:
            yield Answer("quotient", maps, quotient(task.source, lit_task.source_lumi, lit_task.target_lumi))
    if isinstance(method, Pictures):
        strokes = task.control("strokes") if task.target_lumi is not None else None
        yield Answer(method.name, "", method.picture(task), strokes=strokes)
        return
    driving = task if task.target_lumi is not None else estimated
    assert driving
    for drawn in DRAWN:
        strokes = driving.control(drawn)
        if drawn == "strokes":
            for model in (Glow(BundleModel(method)), Blur()):
                yield Answer(model.name, drawn, model.relight(task.source, strokes))
        began = time.perf_counter()
        picture = method.relight(task.source, strokes)
        yield Answer(method.name, drawn, picture, time.perf_counter() - began, strokes)


def _estimated(model: Model, task: Task) -> Task:
    """Return the task with the maps that the model estimates from its two pictures, on the light grid."""
    source, target = model.estimate(task.source), model.estimate(task.truth)
    return replace(task, source_lumi=source, target_lumi=target, mask=None, interest=None, strokes=None)


def _estimate_psnr(estimated: Task, task: Task) -> float:
    assert estimated.source_lumi is not None and task.source_lumi is not None
    grid = estimated.source_lumi.shape[:2]
    everywhere = np.ones(task.source_lumi.shape[:2], np.float32)
    return scaled_psnr(estimated.source_lumi, OPS.reduce_strokes(task.source_lumi, everywhere, grid).light)
