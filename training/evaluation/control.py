"""Measure how a picture responds to the brush: dabs of light on photos with a known Lumi map."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.grid import GridRule
from dior_rt.kernels import Stroke, Strokes
from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.metrics import (
    Photo,
    Raster,
    angle,
    border_ratio,
    decibels,
    hue_angle,
    leakage,
    log_slope,
    mean_square,
    psnr,
    rising,
    rmse,
    steps_not_worse,
)
from dior_rt.training.evaluation.tasks import OPS, Task

Relight = Callable[[Photo, Strokes], Photo]
Color = tuple[float, float, float]

INTENSITIES: Final = (0.25, 0.5, 1.0, 2.0, 4.0)
WHITE: Final = (1.0, 1.0, 1.0)
HUES: Final[tuple[Color, ...]] = (
    (1, 0.05, 0.05),
    (1, 0.5, 0.05),
    (0.05, 1, 0.05),
    (0.05, 1, 1),
    (0.05, 0.05, 1),
    (1, 0.05, 1),
)
DAB: Final = 1 / 6  # a dab's width, as a share of the picture's
FAR: Final = 2 * DAB  # distance from a dab's centre, as a share of the picture's width
DARKEST: Final = 0.05  # below this light, a dab is relative to DEFAULT_LIGHT
DEFAULT_LIGHT: Final = 0.5
SAME: Final = 2  # in 1/255: smaller differences count as equal
WORSE: Final = 0.5  # in 1/255: how much the RMSE may rise before a stroke counts as harmful
MOST_STROKES: Final = 5


@dataclass(frozen=True)
class Response:
    """How the picture follows a white dab at INTENSITIES times the light that is there.

    slope: the mean over dabs of the exponent of linear light against intensity; 1 is in proportion.
    monotonic: the share of dabs under which every increase in intensity brightens the light.
    leakage: the median change FAR from the strongest dab, divided by the change under it.
    """

    slope: float
    monotonic: float
    leakage: float
    dabs: int


@dataclass(frozen=True)
class Chroma:
    """Median angles in degrees, over saturated dabs twice as strong as the light that is there.

    chromaticity: between the RGB of the picture under a dab and that of the same surfaces under the dab's
    light, photo * dab / (light that is there). hue: between the hues of the dab and of the added light; the
    surface's colour shifts it.
    """

    chromaticity: float
    hue: float


@dataclass(frozen=True)
class Progress:
    """The effect of each further stroke of the true map.

    not_worse: the share of strokes that raise the RMSE by no more than WORSE. gain: the mean gain of PSNR
    in dB from the first stroke to the last.
    """

    not_worse: float
    gain: float


def response(relight: Relight, tasks: Iterable[Task]) -> Response:
    """Measure one white dab per task."""
    slopes, monotonic, leaks = [], [], []
    for task in tasks:
        at, base = _place(task)
        under, far = _under(task, at), _far(task, at)
        relit = [
            OPS.decode_srgb(relight(task.source, dab(task.source, at, WHITE, base * intensity)))
            for intensity in INTENSITIES
        ]
        light = [float(after[under].mean()) for after in relit]
        slopes.append(log_slope(INTENSITIES, light))
        monotonic.append(rising(light))
        leaks.append(leakage(OPS.decode_srgb(task.source), relit[-1], under, far))
    return Response(
        float(np.mean(slopes)), float(np.mean(monotonic)), float(np.median(leaks)), dabs=len(slopes)
    )


def chroma(relight: Relight, tasks: Iterable[Task]) -> Chroma:
    """Measure dabs of all HUES on each task."""
    chromaticity, hue = [], []
    for task in tasks:
        assert task.source_lumi is not None
        at, base = _place(task)
        under, photo = _under(task, at), OPS.decode_srgb(task.source)
        surface = (photo / (task.source_lumi + E))[under]
        for color in HUES:
            relit = OPS.decode_srgb(relight(task.source, dab(task.source, at, color, 2 * base)))[under]
            chromaticity.append(angle(relit.mean(axis=0), (surface * np.array(color)).mean(axis=0)))
            hue.append(hue_angle(np.array(color), (relit - photo[under]).mean(axis=0)))
    return Chroma(float(np.median(chromaticity)), float(np.median(hue)))


def progress(relight: Relight, tasks: Iterable[Task]) -> Progress | None:
    """Add a task's strokes one by one. Return None if no task has two separate strokes."""
    from scipy.ndimage import label

    shares, gains = [], []
    for task in tasks:
        whole = task.control("strokes")
        numbers, count = label(whole.mask > 0)
        relit = []
        for most in range(1, min(count, MOST_STROKES) + 1):
            drawn = (numbers > 0) & (numbers <= most)
            strokes = Strokes(np.where(drawn[..., None], whole.light, 0), np.where(drawn, whole.mask, 0))
            relit.append(relight(task.source, strokes))
        if len(relit) > 1:
            shares.append(steps_not_worse([rmse(picture, task.truth) for picture in relit], WORSE))
            gains.append(psnr(relit[-1], task.truth) - psnr(relit[0], task.truth))
    return Progress(float(np.mean(shares)), float(np.mean(gains))) if shares else None


def keep_psnr(relight: Relight, tasks: Iterable[Task]) -> float:
    """Return the PSNR to the photo in dB, outside the strokes, where the truth equals the photo within SAME.

    All tasks are pooled. Without such pixels it is 100.
    """
    squares = []
    for task in tasks:
        strokes = task.control("strokes")
        change = np.abs(task.truth.astype(np.int16) - task.source).max(axis=2)
        still = (strokes.mask == 0) & (change <= SAME)
        if still.any():
            squares.append(mean_square(relight(task.source, strokes)[still], task.source[still]))
    return decibels(float(np.mean(squares))) if squares else decibels(0.0)


@dataclass(frozen=True)
class Borders:
    """Differences across patch borders divided by those inside patches, the means over photos.

    relit: in the logarithm of the light that a white dab makes. estimated: in that of the estimated map.
    """

    relit: float
    estimated: float
    photos: int


def borders(
    relight: Relight, estimate: Callable[[Photo], Raster], grid: GridRule, photos: Iterable[Photo]
) -> Borders:
    """Measure `Borders` on photos at grid size, where each pixel is a cell. patch: grid.multiple."""
    relit, estimated = [], []
    for photo in photos:
        light = OPS.reduce_photo(photo, grid.shape(*photo.shape[:2]))
        small = np.clip(OPS.encode_srgb(light, np.float32), 0, 1)
        height, width = small.shape[:2]
        after = OPS.decode_srgb(relight(small, dab(small, (width / 3, height / 2), WHITE, 1.5)))
        relit.append(border_ratio(np.log((after + E) / (OPS.decode_srgb(small) + E)), grid.multiple))
        estimated.append(border_ratio(np.log(estimate(photo) + E), grid.multiple))
    return Borders(float(np.mean(relit)), float(np.mean(estimated)), len(relit))


def dab(photo: NDArray, at: tuple[float, float], color: Color, intensity: float) -> Strokes:
    """Return one round dab centred at (x, y)."""
    return OPS.draw_strokes([Stroke((at,), DAB * photo.shape[1], color, intensity)], photo.shape[:2])


def _place(task: Task) -> tuple[tuple[float, float], float]:
    """Return a place for a dab away from the border, and the light there."""
    assert task.source_lumi is not None
    height, width = task.source.shape[:2]
    x, y = np.random.default_rng([task.seed, 3]).uniform(0.2, 0.8, 2)
    at = (float(x * width), float(y * height))
    local = float(task.source_lumi[_under(task, at)].mean())
    return at, local if local > DARKEST else DEFAULT_LIGHT


def _under(task: Task, at: tuple[float, float]) -> NDArray[np.bool_]:
    return dab(task.source, at, WHITE, 1.0).mask > 0


def _far(task: Task, at: tuple[float, float]) -> NDArray[np.bool_]:
    rows, columns = np.indices(task.source.shape[:2])
    return np.hypot(columns + 0.5 - at[0], rows + 0.5 - at[1]) > FAR * task.source.shape[1]
