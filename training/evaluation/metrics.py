"""Measures of pictures and of series of figures, as pure functions. Pictures are 8-bit sRGB."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear

Photo = NDArray[np.uint8]
Raster = NDArray[np.float32]

PERFECT: Final = 100.0  # dB for equal pictures
RESAMPLES: Final = 2000
DARK: Final = 1e-4  # linear light below which a logarithm means nothing


def mean_square(one: Photo, other: Photo) -> float:
    """Return the mean squared difference, in 0..255 squared."""
    return float(np.square(one.astype(np.float64) - other).mean())


def rmse(picture: Photo, truth: Photo) -> float:
    """Return the root mean squared difference, in 0..255."""
    return float(np.sqrt(mean_square(picture, truth)))


def decibels(square: float, peak: float = 255.0) -> float:
    """Return 10 log10(peak^2 / square), at most PERFECT."""
    return float(10 * np.log10(peak**2 / max(square, peak**2 * 10 ** (-PERFECT / 10))))


def psnr(picture: Photo, truth: Photo) -> float:
    """Return the peak signal-to-noise ratio in dB."""
    return decibels(mean_square(picture, truth))


def scale_invariant_psnr(picture: Photo, truth: Photo) -> float:
    """PSNR in dB after the one factor on the picture's linear light that fits the truth's best."""
    light, wanted = (srgb_to_linear(shown.astype(np.float64) / 255) for shown in (picture, truth))
    factor = float((light * wanted).sum() / max(float(np.square(light).sum()), DARK**2))
    scaled = 255 * linear_to_srgb(np.clip(light * factor, 0, 1))
    return decibels(float(np.square(scaled - truth).mean()))


def ssim(picture: Photo, truth: Photo) -> float:
    """Return the structural similarity (Wang et al. 2004): scikit-image's, 7 x 7 windows, the mean over RGB.

    Raises ValueError for pictures with a side below 7 pixels.
    """
    from skimage.metrics import structural_similarity

    return float(structural_similarity(picture, truth, channel_axis=2))


def speckle(picture: Photo) -> float:
    """Return the mean distance of pixels to the median of their 3 x 3 neighbours, in 0..255.

    It measures noise and the finest texture.
    """
    from scipy.ndimage import median_filter

    codes = picture.astype(np.float64)
    return float(np.abs(codes - median_filter(codes, (3, 3, 1))).mean())


def interval(values: Sequence[float], level: float = 0.95, seed: int = 0) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the mean (Efron 1979).

    It is the inner `level` of the means of RESAMPLES resamples. For one value, both ends are that value.
    """
    series = np.asarray(values, np.float64)
    drawn = np.random.default_rng(seed).integers(0, len(series), (RESAMPLES, len(series)))
    low, high = np.quantile(series[drawn].mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def log_slope(strengths: Sequence[float], light: Sequence[float]) -> float:
    """Return the exponent p of the fit light = c * strength^p; 1 is in proportion."""
    return float(np.polyfit(np.log(strengths), np.log(np.maximum(light, DARK)), 1)[0])


def rising(values: Sequence[float]) -> bool:
    """Return whether every value exceeds the one before."""
    return bool((np.diff(values) > 0).all())


def angle(one: NDArray, other: NDArray) -> float:
    """Return the degrees between two vectors. A vector without length is 90 degrees from all."""
    a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def hue_angle(one: NDArray, other: NDArray) -> float:
    """Return the degrees between the hues of two RGB vectors: between their parts off the grey axis.

    A vector without hue is 90 degrees from all.
    """
    return angle(one - np.mean(one), other - np.mean(other))


def leakage(before: Raster, after: Raster, drawn: NDArray[np.bool_], far: NDArray[np.bool_]) -> float:
    """Return the change of linear light far from a stroke divided by that under it, both root mean squares.

    before, after: (H, W, 3). drawn, far: (H, W), neither empty. It is 0 if nothing changes.
    """
    change = np.square(after.astype(np.float64) - before).mean(axis=2)
    return float(np.sqrt(change[far].mean() / max(change[drawn].mean(), 1e-12)))


def steps_not_worse(errors: Sequence[float], tolerance: float) -> float:
    """Return the share of steps along a series of errors that raise it by no more than the tolerance."""
    return float((np.diff(errors) <= tolerance).mean())


def border_ratio(light: Raster, patch: int) -> float:
    """Return the mean absolute difference of neighbours across patch borders, divided by that inside patches.

    light (h, w, C) on the grid, whose sides are multiples of `patch` cells. A map whose borders do not
    stand out scores 1, also a flat one.
    """
    across, inside = [], []
    for axis in (0, 1):
        steps = np.abs(np.diff(light.astype(np.float64), axis=axis))
        border = np.arange(1, light.shape[axis]) % patch == 0
        across.append(np.compress(border, steps, axis).ravel())
        inside.append(np.compress(~border, steps, axis).ravel())
    return float((np.concatenate(across).mean() + 1e-9) / (np.concatenate(inside).mean() + 1e-9))


def scaled_psnr(estimate: Raster, truth: Raster) -> float:
    """Return the PSNR in dB of a Lumi map against the true one, after the best global scale.

    Both (h, w, 3), linear. The truth is exposed so that its 99th percentile is display white; then both are
    compared in sRGB clipped to 0..1, with the scale of the estimate that minimises the error.
    """
    from scipy.optimize import minimize_scalar

    exposed = truth / max(float(np.percentile(truth, 99)), DARK)
    guess = float((estimate * exposed).sum() / max(float(np.square(estimate).sum()), DARK**2))
    shown = _shown(exposed)

    def error(stops: float) -> float:
        return float(np.square(_shown(estimate * (max(guess, DARK) * 2**stops)) - shown).mean())

    return decibels(float(minimize_scalar(error, bounds=(-4, 4), method="bounded").fun), peak=1.0)


def _shown(linear: Raster) -> Raster:
    return linear_to_srgb(np.clip(linear, 0, 1)).astype(np.float32)
