"""Methods without a network. Gain and match use the truth's colours: no single grade does better."""

from __future__ import annotations

from typing import Final

import numpy as np

from dior_rt.light import FLOOR
from dior_rt.training.evaluation.metrics import Photo, Raster
from dior_rt.training.evaluation.tasks import OPS

E: Final = np.float32(FLOOR)


def gain(source: Photo, truth: Photo) -> Photo:
    """Scale each channel of the source, in linear light, to the truth's mean."""
    light, wanted = OPS.decode_srgb(source), OPS.decode_srgb(truth)
    return OPS.encode_srgb(light * (wanted.mean((0, 1)) / np.maximum(light.mean((0, 1)), 1e-6)), np.uint8)


def match(source: Photo, truth: Photo) -> Photo:
    """Give each channel of the source the truth's mean and standard deviation, in sRGB."""
    codes, wanted = source.astype(np.float64), truth.astype(np.float64)
    unit = (codes - codes.mean((0, 1))) / np.maximum(codes.std((0, 1)), 1e-6)
    return np.clip(np.rint(unit * wanted.std((0, 1)) + wanted.mean((0, 1))), 0, 255).astype(np.uint8)


def quotient(photo: Photo, source: Raster, target: Raster) -> Photo:
    """Return photo * (target + e) / (source + e) in linear light, for two Lumi maps (h, w, 3).

    Maps of the photo's size act per pixel. Smaller maps are transferred edge-aware, as in the runtime.
    """
    ratio = (target + E) / (source + E)
    if ratio.shape == photo.shape:
        return OPS.encode_srgb(OPS.decode_srgb(photo) * ratio, np.uint8)  # type: ignore[return-value]
    before = OPS.reduce_photo(photo, source.shape[:2])
    return OPS.transfer(photo, before, before * ratio)  # type: ignore[return-value]
