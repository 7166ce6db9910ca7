"""Measure how far a picture is from the reference's, in appearance and in light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dior_rt.grid import GridRule
from dior_rt.kernels import NumpyOps

ROWS = 256  # rows compared at a time, so that a large picture needs no float64 copy


Distance = Callable[[NDArray[np.uint8], NDArray[np.uint8]], float]  # perceptual distance of two pictures


@dataclass(frozen=True)
class Difference:
    """The difference of a picture from the reference.

    psnr: dB over the sRGB-encoded samples, peak 1; None if the pictures are identical.
    largest: the largest difference of any sample, in 1/255.
    light: sum |L - L_ref| / sum L_ref over the linear light L of the cells of a grid.
    lpips: the perceptual distance, if requested.
    """

    psnr: float | None
    largest: float
    light: float
    lpips: float | None = None


def compare_pictures(picture: NDArray, reference: NDArray, lpips: Distance | None = None) -> Difference:
    """Compare two sRGB-encoded pictures (H, W, 3) of the same integer dtype. Raises ValueError otherwise."""
    if picture.shape != reference.shape or picture.dtype != reference.dtype:
        raise ValueError(
            f"{picture.shape} of {picture.dtype} is not comparable to {reference.shape} of {reference.dtype}"
        )
    peak = float(np.iinfo(reference.dtype).max)
    squares, largest = 0.0, 0.0
    for row in range(0, len(reference), ROWS):
        rows = slice(row, row + ROWS)
        error = (picture[rows].astype(np.float64) - reference[rows]) / peak
        squares += float(np.sum(error * error))
        largest = max(largest, float(np.abs(error).max()))
    psnr = -10 * math.log10(squares / reference.size) if squares else None
    seen = lpips(_eight_bits(picture), _eight_bits(reference)) if lpips else None
    return Difference(psnr, 255 * largest, _light_error(picture, reference), seen)


def worst(differences: Sequence[Difference]) -> Difference:
    """Return the worst of each figure."""
    return Difference(
        min((d.psnr for d in differences if d.psnr is not None), default=None),
        max(d.largest for d in differences),
        max(d.light for d in differences),
        max((d.lpips for d in differences if d.lpips is not None), default=None),
    )


def _eight_bits(picture: NDArray) -> NDArray[np.uint8]:
    return picture if picture.dtype == np.uint8 else np.rint(picture / 257).astype(np.uint8)


def _light_error(picture: NDArray, reference: NDArray) -> float:
    ops, grid = NumpyOps(), GridRule().shape(*reference.shape[:2])
    light, wanted = ops.reduce_photo(picture, grid), ops.reduce_photo(reference, grid)
    # The reference may be black. The smallest float keeps the quotient finite.
    return float(np.abs(light - wanted).mean() / max(wanted.mean(), np.finfo(np.float32).tiny))
