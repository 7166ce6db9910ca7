"""Slope: does light under a dab grow in proportion to what is drawn?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from dior_rt.training.evaluation.judges.changes import as_float
from dior_rt.training.evaluation.judges.models import LUMINANCE, Judged
from dior_rt.training.evaluation.judges.painting import WHITE, base_light, disc, line, times
from dior_rt.training.evaluation.judges.subjects import Point, Subject
from dior_rt.training.evaluation.metrics import DARK
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

STRENGTHS: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of the light that the model sees under the dab
DARKEST: Final = 0.05  # of the photo's luminance under a dab; below, the transfer's e decides
DAB: Final = 1 / 6  # a dab's width, of the shorter side
NOTE: Final = (
    "Local slopes of log light under a white dab on log strength, step by step, pictures unclipped; "
    "means over dabs ({dabs}) on objects that the photo does not leave black. 1: light in proportion."
)


def slope(models: Sequence[Judged], subjects: Sequence[Subject]) -> Table:
    """Judge the models by dabs on the marked objects, or in the middle of photos without marks."""
    dabs = [(subject, at) for subject in subjects for at in places(subject)]
    names = [f"x{low:g} to x{high:g}" for low, high in pairwise(STRENGTHS)]
    rows = []
    for model in models:
        slopes = np.array([local_slopes(model, subject, at) for subject, at in dabs])
        figures = {name: Figure.of(slopes[:, step].tolist()) for step, name in enumerate(names)}
        rows.append(Row(model.name, "", figures, None))
    return Table("slope", len(subjects), NOTE.format(dabs=len(dabs)), tuple(rows), None)


def places(subject: Subject) -> list[Point]:
    """Return where dabs go on a photo: the marked places, or its middle, without black surfaces."""
    height, width = subject.photo.shape[:2]
    marked = [triple.dab for triple in subject.marks.triples] if subject.marks else [(width / 2, height / 2)]
    luminance = OPS.decode_srgb(subject.photo) @ LUMINANCE
    radius = DAB * min(height, width) / 2
    return [at for at in marked if float(luminance[disc(luminance.shape, at, radius)].mean()) >= DARKEST]


def local_slopes(model: Judged, subject: Subject, at: Point) -> list[float]:
    """Return the slope of each step between STRENGTHS, for a dab at (x, y)."""
    photo, shape = as_float(subject.photo), subject.photo.shape
    width = DAB * min(shape[:2])
    under = disc(shape, at, width / 2)
    base = base_light(model.estimate(subject.photo), under)
    light = []
    for strength in STRENGTHS:
        relit = model.relight(photo, line(shape, (at,), width, times(WHITE, strength * base)))
        luminance = OPS.decode_srgb(np.asarray(relit, np.float32))[under] @ LUMINANCE
        light.append(max(float(luminance.mean()), DARK))
    return [float(step) for step in np.diff(np.log(light)) / np.diff(np.log(STRENGTHS))]
