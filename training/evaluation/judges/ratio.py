"""Ratio strokes: real pairs, driven by the true ratio of their light.

Under the strokes the control is the factor by which the light changed, applied as `multiply`. No estimate is
asked, so the control cannot leak the target's picture, and it is the same for every model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter

from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.judges.models import Judged, drive
from dior_rt.training.evaluation.judges.subjects import PICTURES
from dior_rt.training.evaluation.layouts import multi_illum, photographed, rene
from dior_rt.training.evaluation.metrics import Photo, psnr, scale_invariant_psnr, ssim
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS, Benchmark, Task

SOFT: Final = 0.02  # the sigma of the blur over a stroke, of the shorter side
MEASURES: Final = {"PSNR": psnr, "SI-PSNR": scale_invariant_psnr, "SSIM": ssim}
NOTE: Final = (
    "Strokes hold the true ratio of the two photos in linear light, blurred over the stroke, as `multiply`."
)


def ratio(models: Sequence[Judged], folder: Path, views: int) -> list[Table]:
    """Judge the models on the real pairs in a folder; see `real_pairs`."""
    tables = []
    for found in real_pairs(folder):
        tasks = found.first(views)
        rows = tuple(Row(model.name, "ratio strokes", ratio_figures(model, tasks), None) for model in models)
        tables.append(Table(f"ratio strokes, {found.name}", len(tasks), NOTE, rows, None))
    return tables


def ratio_figures(model: Judged, tasks: Iterable[Task]) -> dict[str, Figure]:
    """Return the measures of a model's pictures against the second photo of each pair."""
    scores: dict[str, list[float]] = {name: [] for name in MEASURES}
    for task in tasks:
        relit = drive(model, task.source, ratio_strokes(task.source, task.truth, task.seed), "multiply")
        for name, measure in MEASURES.items():
            scores[name].append(measure(relit, task.truth))
    return {name: Figure.of(values) for name, values in scores.items()}


def ratio_strokes(source: Photo, truth: Photo, seed: int) -> Strokes:
    """Return strokes where light changes most, that hold the factor by which it does, at the photo's size.

    Both photos are averaged over the stroke by a Gaussian before they are divided.
    """
    before, after = (OPS.decode_srgb(photo) for photo in (source, truth))
    change = np.abs(np.log((after + E) / (before + E))).max(axis=2)
    mask = OPS.sparsify(after, "strokes", seed, interest=(change**2 + 1e-6).astype(np.float32)).mask
    sigma = SOFT * min(mask.shape)
    inside = gaussian_filter(mask, sigma, mode="constant")[..., None]
    soft = [
        gaussian_filter(light * mask[..., None], (sigma, sigma, 0), mode="constant")
        / np.maximum(inside, 1e-6)
        for light in (before, after)
    ]
    factor = (soft[1] + E) / (soft[0] + E)
    return Strokes(np.where(mask[..., None] > 0, factor, 0).astype(np.float32), mask)


def real_pairs(folder: Path) -> list[Benchmark]:
    """Return the pairs of MultiIllum or ReNe, or else of a folder of scenes.

    A scene is a folder of photos of one view; the folder may also be one scene. Raises InputError where there
    are no pairs.
    """
    if folder.is_dir() and (found := multi_illum(folder) or rene(folder) or scenes(folder)):
        return found
    raise InputError(
        f"There are no pairs of photos in {folder}. Give a folder with a folder of photos for each scene."
    )


def scenes(folder: Path) -> list[Benchmark]:
    """Pair each photo of a scene with the one half the list away."""
    load: list[Callable[[], Task]] = []
    for scene in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
        photos = sorted(path for path in scene.iterdir() if path.suffix.lower() in PICTURES)
        for number, target in enumerate(photos):
            source = photos[number - len(photos) // 2]
            if source != target:
                name = f"{scene.name}-{source.stem}-{target.stem}"
                load.append(partial(photographed, name, source, target, number))
    return [Benchmark(folder.resolve().name, tuple(load), False)] if load else []
