"""Objects: does light that is drawn on an object end at its border?

A dab lies on an object. One point inside and one outside have the same distance to it, so a spread in the
image plane changes both alike: ratio 1. Light in the scene mostly misses what lies behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dior_rt.training.evaluation.judges.changes import as_float, log_change, ratio_of_sums
from dior_rt.training.evaluation.judges.models import LUMINANCE, Judged
from dior_rt.training.evaluation.judges.painting import BLUE, WHITE, Color, base_light, disc, line, times
from dior_rt.training.evaluation.judges.subjects import Subject, Triple, all_triples
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

WIDTH: Final = 0.05  # a dab's width, of the shorter side
SPOT: Final = 0.015  # the radius over which a point's change is averaged, of the shorter side


@dataclass(frozen=True)
class Dab:
    """strength: of the light that the model sees under the dab. darkest, brightest: linear luminance of both
    points between which the photo has room to show the change."""

    color: Color
    strength: float
    darkest: float
    brightest: float


DABS: Final = {
    "white": Dab(WHITE, 2.0, 0.015, 0.5),
    "blue": Dab(BLUE, 2.0, 0.015, 0.5),
    "dark": Dab(WHITE, 0.2, 0.05, 1.0),
}
NOTE: Final = (
    "Log change outside an object by that inside, at the same distance from the dab; sums over the triples "
    "where both points have room to change ({counts}). 1: light ignores objects."
)


def objects(models: Sequence[Judged], subjects: Sequence[Subject]) -> Table:
    """Judge the models by the triples of the subjects."""
    chosen = {name: usable(all_triples(subjects), dab) for name, dab in DABS.items()}
    rows = []
    for model in models:
        figures = {name: border_figure(model, chosen[name], dab) for name, dab in DABS.items()}
        if any(figure.mean for figure in figures.values()):  # a model that changes nothing has no ratio
            rows.append(Row(model.name, "", figures, None))
    counts = ", ".join(f"{len(found)} {name}" for name, found in chosen.items())
    return Table("objects", len(subjects), NOTE.format(counts=counts), tuple(rows), None)


def usable(triples: Sequence[tuple[Subject, Triple]], dab: Dab) -> list[tuple[Subject, Triple]]:
    """Return the triples whose two points are neither too dark nor too bright in the photo for the dab."""
    chosen = []
    for subject, triple in triples:
        luminance = OPS.decode_srgb(subject.photo) @ LUMINANCE
        radius = SPOT * min(luminance.shape)
        spots = [disc(luminance.shape, at, radius) for at in (triple.inside, triple.outside)]
        if all(dab.darkest <= float(luminance[spot].mean()) <= dab.brightest for spot in spots):
            chosen.append((subject, triple))
    return chosen


def border_figure(model: Judged, triples: Sequence[tuple[Subject, Triple]], dab: Dab) -> Figure:
    """Return the change outside by that inside for one kind of dab."""
    inside, outside = [], []
    for subject, triple in triples:
        changes = point_changes(model, subject, triple, dab)
        inside.append(changes[0])
        outside.append(changes[1])
    return ratio_of_sums(outside, inside)


def point_changes(model: Judged, subject: Subject, triple: Triple, dab: Dab) -> tuple[float, float]:
    """Return the length of the mean log change (RGB) inside and outside."""
    photo, shape = as_float(subject.photo), subject.photo.shape
    side = min(shape[:2])
    under = disc(shape, triple.dab, WIDTH * side / 2)
    light = times(dab.color, dab.strength * base_light(model.estimate(subject.photo), under))
    change = log_change(photo, model.relight(photo, line(shape, (triple.dab,), WIDTH * side, light)))
    inside, outside = (
        float(np.linalg.norm(change[disc(shape, at, SPOT * side)].mean(axis=0)))
        for at in (triple.inside, triple.outside)
    )
    return inside, outside
