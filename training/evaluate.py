"""How well a bundle relights held-out renders, by the runtime as people run it, and how it answers the brush.

Pictures are compared as shown: sRGB, 0..255. Copying the source is what every figure stands beside.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from dior_rt.kernels import NumpyOps, Stroke, Strokes
from dior_rt.relight import Relighter
from dior_rt.training.render import View
from dior_rt.training.triplets import Pair, Raster, interest, pair

Photo = NDArray[np.uint8]
Drawn = Literal["dense", "strokes"]

OPS: Final = NumpyOps()
CASES: Final[tuple[tuple[str, Drawn], ...]] = (
    ("replace", "dense"),
    ("replace", "strokes"),
    ("change", "dense"),
    ("change", "strokes"),
)
INTENSITIES: Final = (0.25, 0.5, 1.0, 2.0, 4.0)
HUES: Final = ((1, 0.05, 0.05), (1, 0.5, 0.05), (0.05, 1, 0.05), (0.05, 1, 1), (0.05, 0.05, 1), (1, 0.05, 1))
DAB: Final = 1 / 6  # a dab's width, of the picture's
DARKEST: Final = 0.05  # light below which a dab takes DEFAULT_LIGHT as its base
DEFAULT_LIGHT: Final = 0.5


@dataclass(frozen=True)
class Settings:
    """What is asked of the runtime; None takes the bundle's own."""

    steps: int | None = None
    guidance: float | None = None
    noise_scale: float | None = None


@dataclass(frozen=True)
class Score:
    """rmse: of all pixels, in 0..255. psnr: in dB, and ssim: means over the pictures."""

    rmse: float
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Accuracy:
    """Relit pictures of one kind of pair against the truth. copy: the source's score. seconds: a picture."""

    kind: str
    drawn: str
    pictures: int
    copy: Score
    relit: Score
    seconds: float


@dataclass(frozen=True)
class Response:
    """How the picture under a white dab follows the dab's intensity.

    slope: of log mean linear light against log intensity, the mean over dabs; 1 is light in proportion.
    monotonic: the share of dabs under which every step up in intensity is one in light.
    """

    slope: float
    monotonic: float
    dabs: int


@dataclass(frozen=True)
class Evaluation:
    """settings: as used. hue_degrees: the median angle between a saturated dab's hue and that of the light it
    adds. keep_psnr: in dB, to the photo, where no stroke speaks and no light changed."""

    settings: Settings
    accuracy: tuple[Accuracy, ...]
    response: Response
    hue_degrees: float
    keep_psnr: float


Relight = Callable[[Photo, Strokes], Photo]


def evaluate(relighter: Relighter, views: Sequence[View], settings: Settings, dabs: int = 10) -> Evaluation:
    """Everything below, for one bundle and one choice of settings; dabs: how many views the brush visits."""
    used, relight = prepare(relighter, settings)
    return Evaluation(
        used,
        tuple(accuracy(relight, views, kind, drawn) for kind, drawn in CASES),
        response(relight, views[:dabs]),
        hue_error(relight, views[:dabs]),
        keep_psnr(relight, views),
    )


def prepare(relighter: Relighter, settings: Settings) -> tuple[Settings, Relight]:
    """The settings as used, and the runtime under them; one seed for all pictures."""
    given = {name: value for name, value in asdict(settings).items() if value is not None}
    manifest = replace(relighter.bundle.manifest, **given)
    asked = copy(relighter)
    asked.bundle = replace(relighter.bundle, manifest=manifest)

    def relight(photo: Photo, strokes: Strokes) -> Photo:
        return np.asarray(asked.relight(photo, strokes).picture)

    return Settings(manifest.steps, manifest.guidance, manifest.noise_scale), relight


def accuracy(relight: Relight, views: Sequence[View], kind: str, drawn: Drawn) -> Accuracy:
    """One pair a view, relit from the true dense map or from strokes cut out of it."""
    photos, relits, truths = [], [], []
    began = time.perf_counter()
    for number, view in enumerate(views):
        sample = pair(np.random.default_rng([number, 1]), view, kind)
        photos.append(shown(sample.photo))
        truths.append(shown(sample.relit))
        relits.append(relight(photos[-1], draw(sample, drawn, number)))
    seconds = (time.perf_counter() - began) / len(views)
    return Accuracy(kind, drawn, len(views), score(photos, truths), score(relits, truths), seconds)


def draw(sample: Pair, drawn: Drawn, seed: int) -> Strokes:
    """The pair's target light, whole, or as strokes laid where it matters."""
    if drawn == "dense":
        return Strokes(sample.target, np.ones(sample.target.shape[:2], np.float32))
    where = interest(sample) if sample.kind == "change" else None
    return OPS.sparsify(sample.target, "strokes", seed, interest=where)


def response(relight: Relight, views: Sequence[View]) -> Response:
    """A white dab on every view, at INTENSITIES times the light that is there."""
    slopes, monotonic = [], []
    for number, view in enumerate(views):
        photo, base, at = _place(view, number)
        under = dab(photo, at, (1, 1, 1), 1.0).mask > 0
        light = [
            float(OPS.decode_srgb(relight(photo, dab(photo, at, (1, 1, 1), base * intensity)))[under].mean())
            for intensity in INTENSITIES
        ]
        slopes.append(float(np.polyfit(np.log(INTENSITIES), np.log(np.maximum(light, 1e-4)), 1)[0]))
        monotonic.append(bool((np.diff(light) > 0).all()))
    return Response(float(np.mean(slopes)), float(np.mean(monotonic)), len(views))


def hue_error(relight: Relight, views: Sequence[View]) -> float:
    """The median angle, in degrees, between a saturated dab's hue and that of the light added under it.

    The dabs are twice as strong as the light that is there. The surface's own colour tilts the hue a little.
    """
    angles = []
    for number, view in enumerate(views):
        photo, base, at = _place(view, number)
        for color in HUES:
            strokes = dab(photo, at, color, 2 * base)
            added = OPS.decode_srgb(relight(photo, strokes)) - OPS.decode_srgb(photo)
            angles.append(hue_angle(np.array(color), added[strokes.mask > 0].mean(axis=0)))
    return float(np.median(angles))


def keep_psnr(relight: Relight, views: Sequence[View]) -> float:
    """PSNR to the photo, in dB, where no stroke speaks, when the strokes say what light is there already."""
    squares = []
    for number, view in enumerate(views):
        sample = pair(np.random.default_rng([number, 2]), view, "keep")
        photo, strokes = shown(sample.photo), draw(sample, "strokes", number)
        silent = strokes.mask == 0
        if silent.any():
            squares.append(mean_square(relight(photo, strokes)[silent], photo[silent]))
    return psnr(float(np.mean(squares)))


def shown(linear: Raster) -> Photo:
    """(H, W, 3) linear 0..1 as an 8-bit sRGB picture."""
    return OPS.encode_srgb(linear, np.uint8)  # type: ignore[return-value]


def dab(
    photo: Photo, at: tuple[float, float], color: tuple[float, float, float], intensity: float
) -> Strokes:
    """One round touch of the brush, centred at (x, y)."""
    stroke = Stroke((at,), DAB * photo.shape[1], color, intensity)
    return OPS.draw_strokes([stroke], photo.shape[:2])


def _place(view: View, seed: int) -> tuple[Photo, float, tuple[float, float]]:
    """A photo of the view, a place for a dab away from the border, and the light there."""
    rng = np.random.default_rng([seed, 3])
    sample = pair(rng, view, "keep")
    photo = shown(sample.photo)
    height, width = photo.shape[:2]
    at = float(rng.uniform(0.2, 0.8) * width), float(rng.uniform(0.2, 0.8) * height)
    local = float(sample.source[dab(photo, at, (1, 1, 1), 1.0).mask > 0].mean())
    return photo, local if local > DARKEST else DEFAULT_LIGHT, at


def hue_angle(one: NDArray, other: NDArray) -> float:
    """The angle between the hues of two RGB vectors, in degrees: that of their parts off the grey axis.

    A vector without hue is 90 degrees from all.
    """
    a, b = one - one.mean(), other - other.mean()
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def mean_square(one: Photo, other: Photo) -> float:
    return float(np.square(one.astype(np.float64) - other).mean())


def psnr(square: float) -> float:
    """In dB, of a mean squared error in 0..255; what is equal scores 100."""
    return float(10 * np.log10(255**2 / max(square, 255**2 * 1e-10)))


def score(pictures: Sequence[Photo], truths: Sequence[Photo]) -> Score:
    """The pictures against the truth."""
    from skimage.metrics import structural_similarity

    squares = [mean_square(a, b) for a, b in zip(pictures, truths, strict=True)]
    similar = [structural_similarity(a, b, channel_axis=2) for a, b in zip(pictures, truths, strict=True)]
    return Score(
        float(np.sqrt(np.mean(squares))), float(np.mean([psnr(s) for s in squares])), float(np.mean(similar))
    )


def markdown(evaluation: Evaluation) -> str:
    """The figures as a table and three lines."""
    used = evaluation.settings
    lines = [
        f"{used.steps} steps, guidance {used.guidance:g}, noise {used.noise_scale:g}",
        "",
        "| pair | drawn | pictures | PSNR | RMSE | SSIM | copy: PSNR | RMSE | SSIM | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in evaluation.accuracy:
        scores = (f"{s.psnr:.2f} | {s.rmse:.1f} | {s.ssim:.3f}" for s in (row.relit, row.copy))
        cells = [row.kind, row.drawn, str(row.pictures), *scores, f"{row.seconds:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    answer = evaluation.response
    return "\n".join(
        [
            *lines,
            "",
            f"- light under a dab follows its intensity to the power {answer.slope:.2f}; "
            f"{answer.monotonic:.0%} of {answer.dabs} rise with every step",
            f"- hue of the added light: {evaluation.hue_degrees:.0f} degrees from the dab's",
            f"- unchanged light, where no stroke speaks: {evaluation.keep_psnr:.1f} dB to the photo",
        ]
    )
