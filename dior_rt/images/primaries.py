"""Primaries: the light that red, green and blue stand for, and the conversion of light between sets of them.

Light has one meaning in the whole program: linear light in the photo's own primaries. Strokes and maps that
come in other primaries are converted in linear light before anything is computed. A file that names no
primaries has those of sRGB (Rec. 709).
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
#: CIE x, y of red, green, blue and white.
Chromaticities = tuple[float, float, float, float, float, float, float, float]

_D65, _D50 = (0.3127, 0.329), (0.3457, 0.3585)
SRGB: Chromaticities = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, *_D65)
ADOBE_RGB: Chromaticities = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65)
DISPLAY_P3: Chromaticities = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *_D65)
REC_2020: Chromaticities = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, *_D65)
#: ITU-T H.273, table 2.
BY_CODE: dict[int, Chromaticities] = {
    1: SRGB,
    4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.31, 0.316),
    5: (0.64, 0.33, 0.29, 0.6, 0.15, 0.06, *_D65),
    6: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, *_D65),
    7: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, *_D65),
    9: REC_2020,
    11: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),
    12: DISPLAY_P3,
    22: (0.63, 0.34, 0.295, 0.605, 0.155, 0.077, *_D65),
}

#: XYZ of ICC's white, D50.
D50 = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_SAME = 2e-3  # of two matrices: what ICC's fixed-point numbers and other whites' decimals make of one space


def to_xyz(xy: Chromaticities) -> Matrix:
    """Return (3, 3), linear RGB -> XYZ under D50, by the Bradford transform.

    Raises ValueError for no real space.
    """
    x, y = np.array(xy[::2], np.float64), np.array(xy[1::2], np.float64)
    if not (np.isfinite([x, y]).all() and (np.abs([x, y]) < 10).all() and (y[3] > 1e-3) and abs(y).min() > 0):
        raise ValueError("its primaries make no sense")
    columns = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    primaries, white = columns[:, :3], columns[:, 3]
    if abs(np.linalg.det(primaries)) < 1e-9:
        raise ValueError("its primaries make no sense")
    cone = _BRADFORD @ white
    if not (np.abs(cone) > 1e-6).all():
        raise ValueError("its primaries make no sense")
    to_d50 = np.linalg.inv(_BRADFORD) @ np.diag(_BRADFORD @ D50 / cone) @ _BRADFORD
    return to_d50 @ (primaries * np.linalg.solve(primaries, white))


@cache
def _srgb() -> Matrix:
    return to_xyz(SRGB)


def srgb() -> Matrix:
    """Return the primaries of sRGB."""
    return _srgb().copy()


def conversion(source: Matrix, target: Matrix) -> Matrix | None:
    """Return (3, 3), linear light in source primaries -> target primaries, or None where they are the
    same.
    """
    if np.abs(source - target).max() <= _SAME:
        return None
    return np.linalg.solve(target, source).astype(np.float64)


def convert(light: NDArray[Any], matrix: Matrix | None) -> NDArray[Any]:
    """Convert (..., 3) light by a `conversion`.

    Colours outside the target's gamut are clipped to its border, at 0.
    """
    if matrix is None:
        return light
    return np.maximum(light @ matrix.T.astype(light.dtype), light.dtype.type(0))


# Profiles


def make_profile(xy: Chromaticities, curve: bytes) -> bytes:
    """Return a display profile (ICC version 2) of primaries and a curve tag, such as `gamma_tag` makes."""
    columns = to_xyz(xy).T
    names = (b"rXYZ", b"gXYZ", b"bXYZ")
    tags = {name: _xyz_tag(column) for name, column in zip(names, columns, strict=True)}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    text = b"Written by dior-rt\0"
    tags[b"desc"] = struct.pack(">4sII", b"desc", 0, len(text)) + text + bytes(78)
    tags[b"cprt"] = struct.pack(">4sI", b"text", 0) + b"CC0\0"
    tags[b"wtpt"] = _xyz_tag(D50)
    start = 128 + 4 + 12 * len(tags)
    entries, body = b"", b""
    for name, data in tags.items():
        entries += struct.pack(">4sII", name, start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    header = bytearray(128)
    struct.pack_into(
        ">I4sI4s4s4s", header, 0, start + len(body), b"dior", 0x02400000, b"mntr", b"RGB ", b"XYZ "
    )
    header[36:40] = b"acsp"
    struct.pack_into(">3i", header, 68, *(round(float(v) * 65536) for v in D50))
    return bytes(header) + struct.pack(">I", len(tags)) + entries + body


def gamma_tag(power: float) -> bytes:
    """Return a curve tag of one power, encoded to linear."""
    return struct.pack(">4sIIHxx", b"curv", 0, 1, max(1, min(65535, round(power * 256))))


def parametric_tag(g: float, a: float, b: float, c: float, d: float) -> bytes:
    """Return a curve tag: (a x + b)^g from x = d on, c x below."""
    return struct.pack(">4sIHH5i", b"para", 0, 3, 0, *(round(v * 65536) for v in (g, a, b, c, d)))


SRGB_TAG = parametric_tag(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
REC_709_TAG = parametric_tag(1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081)
#: ITU-T H.273, table 3: the curves that a display shows unchanged.
CURVES_BY_CODE: dict[int, bytes] = {
    1: REC_709_TAG,
    4: gamma_tag(2.2),
    5: gamma_tag(2.8),
    6: REC_709_TAG,
    8: gamma_tag(1.0),
    13: SRGB_TAG,
    14: REC_709_TAG,
    15: REC_709_TAG,
}
HDR_BY_CODE = {16: "PQ", 18: "HLG"}


def adobe_rgb_profile() -> bytes:
    """Return the profile of Adobe RGB as cameras use it."""
    return make_profile(ADOBE_RGB, gamma_tag(563 / 256))


def profile_of_codes(primaries: int, transfer: int) -> bytes:
    """Return the profile that codes of ITU-T H.273 (PNG's cICP, AVIF's nclx) stand for; b"" for sRGB or
    unspecified.

    Raises ValueError for the curves of HDR, because no photo of this program can hold their white.
    """
    if transfer in HDR_BY_CODE:
        raise ValueError(
            f"it is an HDR picture ({HDR_BY_CODE[transfer]}), brighter than a photo's white; "
            "export it as SDR first, for example as a 16-bit PNG in Display P3 or sRGB"
        )
    xy, curve = BY_CODE.get(primaries, SRGB), CURVES_BY_CODE.get(transfer, SRGB_TAG)
    return b"" if xy is SRGB and curve is SRGB_TAG else make_profile(xy, curve)


def profile_of_png(gamma: bytes, chromaticities: bytes) -> bytes:
    """Return the profile that the bytes of PNG's gAMA and cHRM (b"" for none) stand for; b"" for sRGB.

    Raises ValueError for values that make no sense.
    """
    xy, curve = SRGB, SRGB_TAG
    if len(chromaticities) == 32:
        wx, wy, *rest = (value / 100_000 for value in struct.unpack(">8I", chromaticities))
        given = (*rest, wx, wy)
        if max(abs(a - b) for a, b in zip(given, SRGB, strict=True)) > 2e-3:
            xy = given
    if len(gamma) == 4:
        value = struct.unpack(">I", gamma)[0] / 100_000
        if not 0.05 <= value <= 20:
            raise ValueError("its gamma makes no sense")
        if abs(value - 1 / 2.2) > 1e-3:  # many files use 0.45455 to mean sRGB without naming it
            curve = gamma_tag(1 / value)
    return b"" if xy is SRGB and curve is SRGB_TAG else make_profile(xy, curve)


def _xyz_tag(xyz: NDArray[np.float64]) -> bytes:
    return struct.pack(
        ">4sI3i", b"XYZ ", 0, *(max(-(1 << 31), min((1 << 31) - 1, round(float(v) * 65536))) for v in xyz)
    )
