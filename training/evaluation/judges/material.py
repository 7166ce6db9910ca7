"""Material: does the estimated Lumi map hold the photo's own colours and patterns?

Light of one colour on a scene of many colours has a Lumi map of one chroma, so the slope of the map's log
chroma on the photo's is 0 for a map that holds no material, and 1 for the photo itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.judges.changes import ratio_of_sums
from dior_rt.training.evaluation.judges.models import LUMINANCE, Judged, blur_formula
from dior_rt.training.evaluation.judges.subjects import Subject
from dior_rt.training.evaluation.metrics import Raster
from dior_rt.training.evaluation.results import Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

NOTE: Final = (
    "Slopes of the estimate on the photo, logarithms, each picture's mean taken out, all pictures together; "
    "R^2 of the estimate's logarithm to the blur formula's, the mean over pictures."
)


def material(models: Sequence[Judged], subjects: Sequence[Subject], name: str) -> Table:
    """Judge the estimates of the models."""
    rows = tuple(Row(model.name, "", material_figures(model, subjects), None) for model in models)
    return Table(f"material, {name}", len(subjects), NOTE, rows, None)


def material_figures(model: Judged, subjects: Sequence[Subject]) -> dict[str, Figure]:
    """Return the slopes of log chroma and log luminance, and R^2 to the blur formula."""
    chroma, luminance, explained = [], [], []
    for subject in subjects:
        estimated = model.estimate(subject.photo)
        photo = OPS.reduce_photo(subject.photo, estimated.shape[:2])
        chroma.append(_products(log_chroma(photo), log_chroma(estimated)))
        luminance.append(_products(log_luminance(photo), log_luminance(estimated)))
        explained.append(squared_correlation(np.log(estimated + E), np.log(blur_formula(photo) + E)))
    return {
        "chroma slope": ratio_of_sums(*zip(*chroma, strict=True)),
        "luminance slope": ratio_of_sums(*zip(*luminance, strict=True)),
        "R^2 to blur": Figure.of(explained),
    }


def log_luminance(light: Raster) -> Raster:
    """Return log(luminance + e), (h, w, 1)."""
    return np.log(light @ LUMINANCE + E)[..., None]


def log_chroma(light: Raster) -> Raster:
    """Return the logarithms of R / G and B / G, e added to each, (h, w, 2)."""
    logs = np.log(light + E)
    return logs[..., [0, 2]] - logs[..., 1:2]


def squared_correlation(one: Raster, other: Raster) -> float:
    """Return the share of the variance of one map (h, w, C) that the best multiple of the other explains.

    A constant map gives 0.
    """
    covariance, variance = _products(other, one)
    return covariance**2 / max(variance * _products(one, one)[0], 1e-12)


def _products(x: Raster, y: Raster) -> tuple[float, float]:
    """Return sum(x y) and sum(x x), each channel's mean taken out."""
    dx, dy = (raster.astype(np.float64) - raster.mean(axis=(0, 1)) for raster in (x, y))
    return float((dx * dy).sum()), float((dx * dx).sum())
