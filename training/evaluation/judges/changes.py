"""What a judge reads off a picture before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.metrics import RESAMPLES, Photo, Raster
from dior_rt.training.evaluation.results import Figure
from dior_rt.training.evaluation.tasks import OPS


def as_float(photo: Photo) -> Raster:
    """Return the 8-bit photo as float sRGB in 0..1: a model's answer to it is not clipped to 8 bits."""
    return photo.astype(np.float32) / np.float32(255)


def log_change(before: Photo | Raster, after: Photo | Raster) -> Raster:
    """Return log((after + e) / (before + e)) of two sRGB pictures, in linear light, (H, W, 3)."""
    one, other = (np.maximum(OPS.decode_srgb(np.asarray(picture)), 0) for picture in (before, after))
    return np.log((other + E) / (one + E))


def ratio_of_sums(tops: Sequence[float], bottoms: Sequence[float]) -> Figure:
    """Return sum(tops) / sum(bottoms) and its 95 % bootstrap interval over the pairs.

    Larger bottoms weigh more, so a picture in which next to nothing happens decides nothing. Bottoms that are
    all 0 give 0.
    """
    pairs = np.array([tops, bottoms], np.float64)
    drawn = np.random.default_rng(0).integers(0, pairs.shape[1], (RESAMPLES, pairs.shape[1]))
    low, high = np.quantile(_ratio(pairs[:, drawn].sum(axis=2)), [0.025, 0.975])
    return Figure(float(_ratio(pairs.sum(axis=1))), float(low), float(high))


def _ratio(pair: np.ndarray) -> np.ndarray:
    return np.divide(pair[0], pair[1], out=np.zeros_like(pair[0]), where=pair[1] > 0)
