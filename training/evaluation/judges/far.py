"""Far: does the photo stay where nothing was drawn?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dior_rt.training.evaluation.judges.changes import as_float, log_change
from dior_rt.training.evaluation.judges.models import Blend, Judged
from dior_rt.training.evaluation.judges.painting import WHITE, base_light, disc, line, times
from dior_rt.training.evaluation.judges.subjects import Subject
from dior_rt.training.evaluation.metrics import leakage
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

DAB: Final = 1 / 6  # a dab's width, of the shorter side
FAR: Final = 2 * DAB  # from the dab's centre, of the shorter side
STRENGTH: Final = 3.0  # of the light that the model sees under the dab
NOTE: Final = (
    "Change further than two dab widths from the centre of a white dab by that under it, root mean squares, "
    "of linear light and of its logarithm; means over photos."
)


def far(models: Sequence[Judged], subjects: Sequence[Subject]) -> Table:
    """Judge the models in every blend mode that they have.

    The dab lies on the first marked object of each photo, or in its middle.
    """
    rows = []
    for model in models:
        for blend in ("set", "add", "multiply"):
            if blend in model.blends:
                shares = np.array([far_shares(model, subject, blend) for subject in subjects])
                names = ("linear light", "logarithm")
                figures = {name: Figure.of(shares[:, k].tolist()) for k, name in enumerate(names)}
                rows.append(Row(model.name, blend, figures, None))
    return Table("far", len(subjects), NOTE, tuple(rows), None)


def far_shares(model: Judged, subject: Subject, blend: Blend) -> tuple[float, float]:
    """Return the change far away by that under the dab, of linear light and of its logarithm; 0 where nothing
    changes."""
    photo, shape = as_float(subject.photo), subject.photo.shape
    height, width = shape[:2]
    side = min(height, width)
    at = subject.marks.triples[0].dab if subject.marks else (width / 2, height / 2)
    under, beyond = disc(shape, at, DAB * side / 2), ~disc(shape, at, FAR * side)
    base = 1.0 if blend == "multiply" else base_light(model.estimate(subject.photo), under)
    strength = (STRENGTH - 1 if blend == "add" else STRENGTH) * base
    strokes = line(shape, (at,), DAB * side, times(WHITE, strength))
    relit = model.relight(photo, strokes, blend)
    linear = leakage(OPS.decode_srgb(photo), OPS.decode_srgb(relit), under, beyond)
    return linear, leakage(np.zeros_like(photo), log_change(photo, relit), under, beyond)
