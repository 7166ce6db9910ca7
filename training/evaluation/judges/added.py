"""Added: one lamp is added on renders, and what it does not reach should stay the photo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.evaluation.benchmarks import renders
from dior_rt.training.evaluation.control import SAME
from dior_rt.training.evaluation.judges.models import Blend, Judged
from dior_rt.training.evaluation.metrics import decibels, mean_square, psnr
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import Task

SEED: Final = 4
NOTE: Final = (
    f"Strokes of the true map. Still: PSNR in dB where nothing is drawn and the truth differs from the photo "
    f"by at most {SAME} of 255, all pixels together. Whole: PSNR of the picture."
)


def added(models: Sequence[Judged], folder: Path, views: int) -> Table:
    """Judge the models on the first views of a folder of renders. Raises InputError where there are none."""
    found = renders(folder, ("add",), SEED)
    if not found:
        raise InputError(f"There are no renders in {folder}, which the judge `added` needs.")
    tasks = list(found[0].first(views))
    blends: tuple[Blend, ...] = ("set", "add")
    rows = tuple(
        Row(model.name, blend, added_figures(model, tasks, blend), None)
        for model in models
        for blend in blends
        if blend in model.blends
    )
    return Table("added", len(tasks), NOTE, rows, None)


def added_figures(model: Judged, tasks: Sequence[Task], blend: Blend) -> dict[str, Figure]:
    """Return the PSNR where the lamp does not shine, and of the whole picture."""
    squares, whole = [], []
    for task in tasks:
        strokes = task.control("strokes")
        if blend == "add":
            assert task.source_lumi is not None
            strokes = Strokes(np.maximum(strokes.light - task.source_lumi, 0), strokes.mask)
        relit = model.relight(task.source, strokes, blend)
        whole.append(psnr(relit, task.truth))
        change = np.abs(task.truth.astype(np.int16) - task.source).max(axis=2)
        still = (strokes.mask == 0) & (change <= SAME)
        if still.any():
            squares.append(mean_square(relit[still], task.source[still]))
    kept = decibels(float(np.mean(squares))) if squares else decibels(0.0)
    return {"PSNR still": Figure(kept, kept, kept), "PSNR whole": Figure.of(whole)}
