"""The physics of light in one place: constants, and the encodings in which networks see and predict light.

    encode_lumi(L) = log(1 + 8 L) / log(1 + 8 peak)      light as networks see it; peak is encoded as 1
    ratio          = (relit + e) / (source + e)          a change of light; e = FLOOR keeps black finite
    x0 (relight)   = 4 (relit - photo)                   data variable of the flow, both sRGB-encoded
    x0 (estimate)  = 2 encode_lumi(L) - 1

Everything here is NumPy, float32 in and out. `dior_rt.training.light` holds the same functions in torch and
is tested against this module. The sRGB curve is `dior_rt.kernels.color`; the shift of a schedule is
`dior_rt.flow.schedule.shift_sigma`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.kernels.color import srgb_to_linear
from dior_rt.kernels.transfer import EPSILON

Array = NDArray[np.float32]

#: Light, as a share of display white, that is added to both sides of a quotient. Black can then be lit, and
#: the dark parts of a photo below it have little influence.
FLOOR: Final = EPSILON
#: Light that reaches a surface where no source shines: it has bounced there.
BOUNCED: Final = 0.02
#: Scale of the logarithm in which light is encoded: log(1 + LUMI_SCALE L).
LUMI_SCALE: Final = 8.0
#: The light that is encoded as 1 in the pictures of Lumi maps for qwen.
LUMI_PEAK: Final = 4.0
#: Scale of the data variable of relighting: RELIT_SCALE (relit - photo).
RELIT_SCALE: Final = 4.0


def encode_lumi(light: Array, peak: float = 1.0) -> Array:
    """Return log(1 + 8 L) / log(1 + 8 peak) of linear light: 0 for darkness, 1 for `peak`."""
    return np.log1p(np.float32(LUMI_SCALE) * light) / _span(peak)


def decode_lumi(encoded: Array, peak: float = 1.0) -> Array:
    """Return linear light: the inverse of `encode_lumi`, for values of at least 0."""
    return np.expm1(encoded * _span(peak)) / np.float32(LUMI_SCALE)


def log_ratio(relit: Array, source: Array) -> Array:
    """Return log((relit + e) / (source + e)) of linear light, with e = FLOOR."""
    return np.log((relit + np.float32(FLOOR)) / (source + np.float32(FLOOR)))


def apply_log_ratio(source: Array, ratio: Array) -> Array:
    """Return (source + e) exp(ratio) - e, at least 0: the inverse of `log_ratio`."""
    return np.maximum((source + np.float32(FLOOR)) * np.exp(ratio) - np.float32(FLOOR), 0)


def relit_from_x0(x0: Array, photo: Array) -> Array:
    """Return the relit picture, sRGB-encoded 0..1, from the flow's data variable and the photo."""
    return np.clip(photo + x0 / np.float32(RELIT_SCALE), 0, 1)


def lumi_from_x0(x0: Array) -> Array:
    """Return the estimated Lumi map, linear >= 0, from the flow's data variable."""
    return decode_lumi(np.maximum((x0 + 1) / 2, 0))


def draw_lumi(light: Array, mask: Array, peak: float = LUMI_PEAK) -> NDArray[np.uint8]:
    """Return strokes (h, w, 3) and their mask (h, w) as an 8-bit picture; unspecified light is black."""
    encoded = encode_lumi(np.where(mask[..., None] > 0, light, 0), peak)
    return np.rint(np.clip(encoded, 0, 1) * 255).astype(np.uint8)


def undraw_lumi(picture: Array, peak: float = LUMI_PEAK) -> Array:
    """Return linear light from a picture 0..1 of a Lumi map: the inverse of `draw_lumi`."""
    return decode_lumi(picture, peak)


def pack_patches(latents: Array, patch: int) -> Array:
    """Return latents (1, z, h, w) as tokens (h w / patch^2, z patch^2), row by row."""
    _, channels, rows, columns = latents.shape
    split = latents.reshape(channels, rows // patch, patch, columns // patch, patch)
    return np.ascontiguousarray(split.transpose(1, 3, 0, 2, 4).reshape(-1, channels * patch**2))


def unpack_patches(tokens: Array, size: tuple[int, int], patch: int) -> Array:
    """Return latents (1, z, h, w) from the tokens of (rows, columns): the inverse of `pack_patches`."""
    split = tokens.reshape(*size, -1, patch, patch).transpose(2, 0, 3, 1, 4)
    return np.ascontiguousarray(split.reshape(1, -1, size[0] * patch, size[1] * patch))


def decode_small(encoded: Array) -> Array:
    """Return a small sRGB picture in linear light.

    It is computed on the host, because a device would compile for it.
    """
    return srgb_to_linear(encoded).astype(np.float32)


def _span(peak: float) -> np.float32:
    return np.log1p(np.float32(LUMI_SCALE * peak))
