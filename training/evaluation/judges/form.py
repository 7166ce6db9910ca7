"""Form: is the change of light more than a soft glow?

A change of real light follows shapes: edges of shadows, orientation, occlusion. A blur of 4 % of the longer
side keeps 0.56 of the variance of its logarithm (MultiIllum everett_kitchen2 and a statue under 12 lamps).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter

from dior_rt.training.evaluation.judges.changes import as_float, log_change, ratio_of_sums
from dior_rt.training.evaluation.judges.models import Judged
from dior_rt.training.evaluation.judges.painting import WHITE, base_light, line, times
from dior_rt.training.evaluation.judges.subjects import Subject
from dior_rt.training.evaluation.metrics import Raster
from dior_rt.training.evaluation.results import Row, Table

WIDTH: Final = 0.08  # the stroke's, of the shorter side
STRENGTH: Final = 3.0  # of the light that the model sees under the stroke
BLUR: Final = 0.04  # the Gaussian's sigma, of the longer side
STILL: Final = 1e-10  # variance of a log change below which nothing changed
NOTE: Final = (
    "Variance of the log change under one white stroke that a blur of 4 % of the longer side keeps; "
    "changes of real light: 0.56."
)


def form(models: Sequence[Judged], subjects: Sequence[Subject]) -> Table:
    """Judge the models by one white stroke on each photo; models that change nothing have no row."""
    rows = []
    for model in models:
        pairs = [blurred_share(stroke_change(model, subject)) for subject in subjects if subject.marks]
        if any(total for _, total in pairs):
            figure = ratio_of_sums(*zip(*pairs, strict=True))
            rows.append(Row(model.name, "", {"explained by blur": figure}, None))
    return Table("form", len(subjects), NOTE, tuple(rows), None)


def stroke_change(model: Judged, subject: Subject) -> Raster:
    """Return the log change (H, W, 3) under the subject's white stroke."""
    assert subject.marks
    shape, width = subject.photo.shape, WIDTH * min(subject.photo.shape[:2])
    drawn = line(shape, subject.marks.stroke, width, WHITE)
    strength = STRENGTH * base_light(model.estimate(subject.photo), drawn.mask > 0.5)
    photo = as_float(subject.photo)
    strokes = line(shape, subject.marks.stroke, width, times(WHITE, strength))
    return log_change(photo, model.relight(photo, strokes))


def blurred_share(change: Raster) -> tuple[float, float]:
    """Return the share of the variance of a change's mean over channels that a blur keeps, and 1.

    A map without change gives 0 and 0, and so does not count.
    """
    grey = change.astype(np.float64).mean(axis=2)
    variance = float(grey.var())
    if variance < STILL:
        return 0.0, 0.0
    return float(gaussian_filter(grey, BLUR * max(grey.shape), mode="nearest").var()) / variance, 1.0
