"""Identity: a photo's own Lumi map, drawn on it, should give the photo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, get_args

from dior_rt.kernels.ops import Mode
from dior_rt.training.evaluation.judges.models import Judged
from dior_rt.training.evaluation.judges.subjects import Subject
from dior_rt.training.evaluation.metrics import psnr
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

MODES: Final[tuple[Mode, ...]] = get_args(Mode)
NOTE: Final = (
    "PSNR to the photo, in dB, of the model's own estimate drawn on it: strokes, coarse cells, all of it."
)


def identity(models: Sequence[Judged], subjects: Sequence[Subject]) -> Table:
    """Judge the models on each photo, in the three modes in which a map is drawn."""
    rows = []
    for model in models:
        scores: dict[str, list[float]] = {f"PSNR {mode}": [] for mode in ("strokes", "coarse", "dense")}
        for seed, subject in enumerate(subjects):
            estimated = model.estimate(subject.photo)
            for mode in MODES:
                relit = model.relight(subject.photo, OPS.sparsify(estimated, mode, seed))
                scores[f"PSNR {mode}"].append(psnr(relit, subject.photo))
        figures = {name: Figure.of(values) for name, values in scores.items()}
        rows.append(Row(model.name, "", figures, None))
    return Table("identity", len(subjects), NOTE, tuple(rows), None)
