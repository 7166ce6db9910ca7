"""ICC profiles: convert a photo's numbers to light, and exchange its curve for that of sRGB.

All code here that computes light expects the sRGB curve. A photo with other RGB primaries (Display P3, Adobe
RGB, ProPhoto ...) keeps them. Only its curve is exchanged, and it is exchanged back when the photo is
written. So no colour is clipped to sRGB's gamut, light is still added and scaled linearly, and a pixel whose
light does not change comes out unchanged. LittleCMS converts the colours of a photo without such curves
(CMYK, scanner tables) to sRGB.

ICC.1:2022 (profile version 4.4): section 7 for the tag table, 10.6 curveType, 10.18 parametricCurveType.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from dior_rt.kernels.color import linear_to_srgb

Pixels = NDArray[Any]  # uint8 or uint16


@dataclass(frozen=True)
class Curves:
    """The curves of a photo: `srgb[c, k]` is code k of channel c, sRGB-encoded, 0..1.

    There are 256 or 65,536 codes and 3 channels (1 for a grey photo). Every row rises.
    """

    srgb: NDArray[np.float64]

    @property
    def is_srgb(self) -> bool:
        """Return whether the curves equal sRGB's to half a step of 8 bits.

        The numbers are then left alone.
        """
        codes = np.linspace(0, 1, self.srgb.shape[1])
        return bool(np.abs(self.srgb - codes).max() <= 0.5 / 255)

    def with_codes(self, codes: int) -> Curves:
        """Return the same curves at another number of codes, interpolated linearly."""
        x = np.linspace(0, 1, self.srgb.shape[1])
        return Curves(np.stack([np.interp(np.linspace(0, 1, codes), x, row) for row in self.srgb]))

    def to_srgb(self, pixels: Pixels) -> NDArray[np.uint16]:
        """Convert (H, W, channels) from the photo's encoding to uint16, sRGB-encoded."""
        tables = np.round(self.srgb * 65535).astype(np.uint16)
        return np.stack([table[pixels[..., c]] for c, table in enumerate(tables)], axis=-1)

    def from_srgb(self, pixels: NDArray[np.uint16]) -> Pixels:
        """Convert back to the nearest code. This undoes `to_srgb` exactly where the photo has 8 bits."""
        top = self.srgb.shape[1] - 1
        dtype = np.uint8 if top == 255 else np.uint16
        tables = [np.interp(np.arange(65536) / 65535, row, np.arange(top + 1)) for row in self.srgb]
        rounded = [np.round(table).astype(dtype) for table in tables]
        return np.stack([table[pixels[..., c]] for c, table in enumerate(rounded)], axis=-1)


@dataclass(frozen=True)
class Coloured:
    """Pixels (H, W, 3) on the sRGB curve, the curves that take them back, the profile to write, and notices
    of losses.
    """

    pixels: Pixels
    curves: Curves | None = None
    icc: bytes = b""
    notices: tuple[str, ...] = ()


def interpret(samples: Pixels, icc: bytes) -> Coloured:
    """Put (H, W, 1 or 3) grey or RGB samples with their ICC profile (b"" for none: sRGB) on the sRGB curve.

    Grey becomes RGB, because the light that falls on it may have a colour. A profile that cannot be used is
    left out, with a notice.
    """
    top = int(np.iinfo(samples.dtype).max)
    grey = samples.shape[-1] == 1 and icc[16:20] == b"GRAY"
    if samples.shape[-1] == 1 and not grey:
        samples = np.repeat(samples, 3, axis=-1)
    if not icc:
        return Coloured(samples)
    try:
        if icc[16:20] != (b"GRAY" if grey else b"RGB "):
            raise ValueError("the colour profile is of another kind than the picture")
        curves = read_curves(icc, top + 1)
        if curves is None:
            return _by_tables(samples, icc)
    except (ValueError, OSError, ImageCms.PyCMSError):
        plain = np.repeat(samples, 3, axis=-1) if grey else samples
        return Coloured(plain, notices=("Its colour profile is damaged or misplaced; it is left out.",))
    if grey:
        encoded = np.round(curves.srgb[0] * top).astype(samples.dtype)[samples]
        return Coloured(np.repeat(encoded, 3, axis=-1))
    if curves.is_srgb:
        return Coloured(samples, icc=icc)
    return Coloured(curves.to_srgb(samples), curves, icc)


def read_primaries(icc: bytes) -> NDArray[np.float64] | None:
    """Return (3, 3), linear RGB -> XYZ under D50, for an RGB profile of primaries and curves, else None."""
    try:
        tags = _tags(icc)
        if icc[16:20] != b"RGB " or b"A2B0" in tags:
            return None
        columns = [struct.unpack_from(">3i", tags[name], 8) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    except (ValueError, KeyError, struct.error):
        return None
    matrix = np.array(columns, np.float64).T / 65536
    return matrix if abs(np.linalg.det(matrix)) > 1e-6 else None


def convert_to_srgb(image: Image.Image, icc: bytes) -> Image.Image:
    """Convert an 8-bit picture by its ICC profile to sRGB, relative colorimetric, with black point
    compensation.
    """
    converted = ImageCms.profileToProfile(
        image,
        ImageCms.ImageCmsProfile(io.BytesIO(icc)),
        ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
        outputMode="RGB",
        flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )
    assert converted is not None  # it is None only for a change in place
    return converted


@cache
def srgb_profile() -> bytes:
    """Return an ICC profile of sRGB."""
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def _by_tables(samples: Pixels, icc: bytes) -> Coloured:
    notices: tuple[str, ...] = ()
    if samples.dtype == np.uint16:  # Pillow gives access to LittleCMS, and its colours have 8 bits
        samples = np.round(samples / 257).astype(np.uint8)
        notices = ("Its colour profile is made of tables, so it is converted to 8-bit sRGB.",)
    image = convert_to_srgb(Image.fromarray(samples.squeeze()), icc)
    return Coloured(np.asarray(image), icc=srgb_profile(), notices=notices)


def read_curves(icc: bytes, codes: int) -> Curves | None:
    """Return an RGB or grey profile's curves at `codes` even points, or None where it is not made of curves.

    Raises ValueError for a damaged profile.
    """
    try:
        tags = _tags(icc)
        names = {b"RGB ": (b"rTRC", b"gTRC", b"bTRC"), b"GRAY": (b"kTRC",)}.get(icc[16:20])
        # A colour engine ignores the curves where there is an A2B table, so this reader must, too.
        if names is None or b"A2B0" in tags or any(name not in tags for name in names):
            return None
        x = np.linspace(0, 1, codes)
        linear = np.stack([_curve(tags[name], x) for name in names])
    except (struct.error, IndexError) as error:
        raise ValueError("the colour profile is damaged") from error
    if not np.isfinite(linear).all() or (np.diff(linear) < 0).any() or (linear[:, 0] >= linear[:, -1]).any():
        return None
    srgb = linear_to_srgb(np.clip(linear, 0, 1))
    if codes == 256:
        # A coarse table maps several codes near black to the same light. Two steps of 16 bits keep them
        # apart.
        ramp = np.arange(codes) * 2 / 65535
        srgb = np.maximum.accumulate(srgb - ramp, axis=1) + ramp
    return Curves(srgb / np.maximum(srgb[:, -1:], 1))


def _tags(icc: bytes) -> dict[bytes, bytes]:
    if icc[36:40] != b"acsp":
        raise ValueError("the colour profile is damaged")
    (count,) = struct.unpack_from(">I", icc, 128)
    entries = [struct.unpack_from(">4sII", icc, 132 + 12 * i) for i in range(min(count, 1000))]
    return {name: icc[offset : offset + size] for name, offset, size in entries}


def _curve(tag: bytes, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the linear light 0..1 of the encoded values x by a curveType or parametricCurveType tag."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        values = np.array(struct.unpack_from(f">{count}H", tag, 12), np.float64)
        if count == 0:
            return x
        if count == 1:
            return x ** (values[0] / 256)
        return np.interp(x, np.linspace(0, 1, count), values / 65535)
    if tag[:4] == b"para":
        (kind,) = struct.unpack_from(">H", tag, 8)
        sizes = (1, 3, 4, 5, 7)
        raw = struct.unpack_from(f">{sizes[kind]}i", tag, 12)
        return _parametric(kind, [value / 65536 for value in raw], x)
    raise ValueError("the colour profile is damaged")


def _parametric(kind: int, p: list[float], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Y = (a X + b)^g + e for X >= d, and c X + f below.

    Table 68 of ICC.1:2022 lists which are present.
    """
    g = p[0]
    a, b = (p[1], p[2]) if kind > 0 else (1.0, 0.0)
    c = p[3] if kind >= 3 else 0.0
    d = p[4] if kind >= 3 else (-b / a if a else 0.0)
    e, f = (p[5], p[6]) if kind == 4 else (p[3], p[3]) if kind == 2 else (0.0, 0.0)
    return np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
