"""Run Open Image Denoise on renders, guided by the albedo and the normals that the camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Raster = NDArray[np.float32]


@dataclass(frozen=True)
class Guides:
    """The guides of one camera's view, free of noise.

    albedo: (H, W, 3) in 0..1. normal: (H, W, 3), unit vectors.
    """

    albedo: Raster
    normal: Raster

    def picture(self, noisy: Raster) -> Raster:
        """Return the denoised picture (H, W, 3), linear, of these surfaces with their materials."""
        return _denoised(noisy, self.albedo, self.normal)

    def lumi_map(self, noisy: Raster) -> Raster:
        """Return the denoised Lumi map (H, W, 3), of the same surfaces in white."""
        return _denoised(noisy, np.ones_like(self.albedo), self.normal)


def _denoised(noisy: Raster, albedo: Raster, normal: Raster) -> Raster:
    import mitsuba_oidn

    clean = mitsuba_oidn.denoise(np.ascontiguousarray(noisy), albedo, normal, hdr=True, clean_aux=True)
    # This is a view of its buffer, which the next call may reuse.
    return np.maximum(clean, 0, dtype=np.float32)
