"""What is judged: a bundle, and the baselines, which stand beside it in every table."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Final, Literal, Protocol

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from dior_rt.grid import GridRule
from dior_rt.kernels import Strokes
from dior_rt.training.evaluation.baselines import E
from dior_rt.training.evaluation.methods import Model
from dior_rt.training.evaluation.metrics import Photo, Raster
from dior_rt.training.evaluation.tasks import OPS

Blend = Literal["set", "add", "multiply"]
SET_ONLY: Final[frozenset[Blend]] = frozenset({"set"})
ALL_BLENDS: Final[frozenset[Blend]] = frozenset({"set", "add", "multiply"})

SPREAD: Final = 0.2  # glow's sigma, of the shorter side
BLUR: Final = 0.01  # the blur formula's sigma, of the shorter side
LUMINANCE_POWER: Final = 0.72
CHROMA_SHARE: Final = 0.55
LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB (IEC 61966-2-1)
DARKEST_FACTOR: Final = 1e-3  # `multiply` by less counts as this


class Judged(Protocol):
    """A model as judges see it.

    name: of its row. blends: the modes of strokes that `relight` takes; `drive` stands in for the others.
    """

    @property
    def name(self) -> str: ...

    @property
    def blends(self) -> frozenset[Blend]: ...

    def estimate(self, photo: Photo | Raster) -> Raster:
        """Return the photo's own Lumi map (h, w, 3), linear, on the model's light grid."""
        ...

    def relight(self, photo: Photo | Raster, strokes: Strokes, blend: Blend = "set") -> Photo:
        """Return the photo (H, W, 3) under the strokes, in its dtype. Strokes have the photo's size or the
        light grid's."""
        ...


def drive(model: Judged, photo: Photo | Raster, strokes: Strokes, blend: Blend) -> Photo:
    """Relight in any blend mode. A model without the mode gets the light that it stands for, from its own
    estimate, as `set`."""
    if blend in model.blends:
        return model.relight(photo, strokes, blend)
    return model.relight(photo, as_set(strokes, model.estimate(photo), blend))


def as_set(strokes: Strokes, estimated: Raster, blend: Blend) -> Strokes:
    """Return strokes on the grid of `estimated` that set the light which `blend` makes of it."""
    drawn = on_grid(strokes, estimated.shape[:2])
    light = {"set": drawn.light, "add": estimated + drawn.light, "multiply": estimated * drawn.light}[blend]
    return Strokes(np.where(drawn.mask[..., None] > 0, light, 0).astype(np.float32), drawn.mask)


def on_grid(strokes: Strokes, grid: tuple[int, ...]) -> Strokes:
    """Return the strokes reduced to (rows, columns)."""
    if strokes.mask.shape == grid:
        return strokes
    return OPS.reduce_strokes(strokes.light, strokes.mask, (grid[0], grid[1]))


class BundleModel:
    """A bundle, as `Judged`. Estimates are kept, because judges ask for those of few photos many times."""

    def __init__(self, model: Model, blends: frozenset[Blend] = SET_ONLY) -> None:
        self.model, self.blends, self.name = model, blends, model.name
        self._estimates: dict[tuple[str, tuple[int, ...], bytes], Raster] = {}

    def estimate(self, photo: Photo | Raster) -> Raster:
        key = str(photo.dtype), photo.shape, hashlib.sha256(photo.tobytes()).digest()
        if key not in self._estimates:
            self._estimates[key] = self.model.estimate(photo)
        return self._estimates[key]

    def relight(self, photo: Photo | Raster, strokes: Strokes, blend: Blend = "set") -> Photo:
        return self.model.relight(photo, strokes)


@dataclass(frozen=True)
class Copy:
    """The photo, whatever is drawn; its estimate is the photo as well."""

    name: str = "copy"
    blends: frozenset[Blend] = ALL_BLENDS

    def estimate(self, photo: Photo | Raster) -> Raster:
        return OPS.reduce_photo(photo, GridRule().shape(*photo.shape[:2]))

    def relight(self, photo: Photo | Raster, strokes: Strokes, blend: Blend = "set") -> Photo:
        return np.array(photo)


class Glow:
    """The strokes' log-ratio to a model's own estimate, spread by one Gaussian; no network completes light.

    With r = log((drawn + e) / (own + e)) under the strokes and G a Gaussian of SPREAD times the shorter side,
    the log-ratio elsewhere is  G(mask r) / G(mask) * exp(-d^2 / 2 sigma^2),  d the distance to the nearest
    stroke; under the strokes it is r itself.
    """

    blends = ALL_BLENDS

    def __init__(self, base: Judged, name: str = "glow") -> None:
        self.base, self.name = base, name

    def estimate(self, photo: Photo | Raster) -> Raster:
        return self.base.estimate(photo)

    def relight(self, photo: Photo | Raster, strokes: Strokes, blend: Blend = "set") -> Photo:
        if blend == "multiply":  # a factor on the light that is there needs no estimate
            grid = GridRule().shape(*photo.shape[:2])
            drawn = on_grid(strokes, grid)
            ratio = np.log(np.maximum(drawn.light, DARKEST_FACTOR))
        else:
            estimated = self.estimate(photo)
            grid = estimated.shape[:2]
            drawn = as_set(strokes, estimated, blend)
            ratio = np.log((drawn.light + E) / (estimated + E))
        source = OPS.reduce_photo(photo, grid)
        relit = source * np.exp(spread(ratio, drawn.mask > 0))
        return OPS.transfer(photo, source, relit.astype(np.float32))


class Blur(Glow):
    """Glow on the blur formula in place of an estimate: no network at all."""

    def __init__(self) -> None:
        super().__init__(Copy(), "blur")

    def estimate(self, photo: Photo | Raster) -> Raster:
        return blur_formula(OPS.reduce_photo(photo, GridRule().shape(*photo.shape[:2])))


def blur_formula(photo: Raster) -> Raster:
    """Return the linear photo (h, w, 3) blurred, its luminance to the power of LUMINANCE_POWER and its chroma
    times CHROMA_SHARE.

    Chroma is the log-ratio of each channel to the luminance.
    """
    sigma = BLUR * min(photo.shape[:2])
    soft = np.maximum(gaussian_filter(photo, (sigma, sigma, 0), mode="nearest"), 0)
    luminance = soft @ LUMINANCE
    chroma = ((soft + E) / (luminance + E)[..., None]) ** CHROMA_SHARE
    return (luminance**LUMINANCE_POWER)[..., None] * chroma


def spread(ratio: Raster, drawn: np.ndarray) -> Raster:
    """Return the log-ratio (h, w, 3) under `drawn` (h, w) carried on to everywhere; see `Glow`."""
    sigma = SPREAD * min(drawn.shape)
    weight = gaussian_filter(drawn.astype(np.float64), sigma, mode="constant", truncate=8)
    drawn_ratio = np.where(drawn[..., None], ratio, 0).astype(np.float64)
    total = gaussian_filter(drawn_ratio, (sigma, sigma, 0), mode="constant", truncate=8)
    mean = total / np.maximum(weight, 1e-30)[..., None]
    near = np.exp(-np.square(distance_transform_edt(~drawn) / sigma) / 2)[..., None]
    return np.where(drawn[..., None], ratio, mean * near).astype(np.float32)


def baselines(model: Judged) -> tuple[Judged, ...]:
    """Return what stands beside a model in every table."""
    return Glow(model), Blur(), Copy()
