"""Run Open Image Denoise on renders, guided by the albedo and normals that the camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Raster = NDArray[np.float32]


def denoised(noisy: Raster, albedo: Raster, normals: Raster) -> Raster:
    """Return the raster (H, W, 3), linear and >= 0, without its noise.

    The guides are (H, W, 3), free of noise.
    """
    import mitsuba_oidn

    clean = mitsuba_oidn.denoise(
        np.ascontiguousarray(noisy), np.ascontiguousarray(albedo), np.ascontiguousarray(normals), hdr=True,
        clean_aux=True,
    )  # fmt: skip
    # This is a view of a buffer that the next call may reuse.
    return np.maximum(clean, 0, dtype=np.float32)
