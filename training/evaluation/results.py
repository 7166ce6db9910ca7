"""The results of an evaluation as records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dior_rt.kernels import Strokes
from dior_rt.training.evaluation.control import Borders, Chroma, Progress, Response
from dior_rt.training.evaluation.methods import Settings
from dior_rt.training.evaluation.metrics import Photo, interval
from dior_rt.training.evaluation.tasks import Task


@dataclass(frozen=True)
class Figure:
    """A mean over pictures and its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> Figure:
        """Return the mean and interval of at least one value."""
        return Figure(float(np.mean(values)), *interval(values))


@dataclass(frozen=True)
class Row:
    """A method's figures by measure. control: the light that drove it. seconds: per picture."""

    method: str
    control: str
    figures: dict[str, Figure]
    seconds: float | None


@dataclass(frozen=True)
class Table:
    """The results on one benchmark.

    estimate: PSNR in dB of the estimated map of the source after the best global scale, if the true map is
    known.
    control: the origin of the control.
    """

    benchmark: str
    pictures: int
    control: str
    rows: tuple[Row, ...]
    estimate: Figure | None


@dataclass(frozen=True)
class Example:
    """One row of the contact sheet."""

    task: Task
    strokes: Strokes | None
    result: Photo


@dataclass(frozen=True)
class Control:
    """The figures of module `control`. progress: None if no task has two strokes."""

    response: Response
    chroma: Chroma
    progress: Progress | None
    keep_psnr: float
    add_psnr: float


@dataclass(frozen=True)
class Evaluation:
    """All results of one method. settings: as used, or None for a folder of pictures."""

    method: str
    settings: Settings | None
    tables: tuple[Table, ...]
    control: Control | None = None
    borders: Borders | None = None
