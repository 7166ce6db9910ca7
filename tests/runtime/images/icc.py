"""ICC profiles made by hand, so that wide-gamut photos can be tested where no profile is installed.

LittleCMS reads them in the tests, which shows that they are sound and what they mean.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

D50 = (0.9642, 1.0, 0.8249)
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

#: CIE xy of red, green, blue and white, and the curve's tag.
DISPLAY_P3 = (((0.68, 0.32), (0.265, 0.69), (0.15, 0.06)), (0.3127, 0.329))
SRGB = (((0.64, 0.33), (0.3, 0.6), (0.15, 0.06)), (0.3127, 0.329))
ADOBE_RGB = (((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)), (0.3127, 0.329))
PROPHOTO = (((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), (0.3457, 0.3585))

SRGB_CURVE = struct.pack(
    ">4sIHH5i",
    b"para",
    0,
    3,
    0,
    *(round(v * 65536) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)),
)


def gamma(value: float) -> bytes:
    """Return a curveType tag of one power."""
    return struct.pack(">4sIIHxx", b"curv", 0, 1, round(value * 256))


def table(values: Sequence[float]) -> bytes:
    """Return a curveType tag of a table of values 0..1."""
    codes = [round(v * 65535) for v in values]
    return struct.pack(f">4sII{len(codes)}H", b"curv", 0, len(codes), *codes)


def rgb_profile(space: tuple, curve: bytes) -> bytes:
    """Return a display profile of primaries and a white point (xy), with one curve for all channels."""
    red, green, blue = to_xyz(space).T
    tags = {b"rXYZ": _xyz_tag(red), b"gXYZ": _xyz_tag(green), b"bXYZ": _xyz_tag(blue)}
    return _profile(b"RGB ", tags | dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve))


def table_profile(kind: bytes, curve: np.ndarray, corners: np.ndarray) -> bytes:
    """A profile made of a table (lut16Type): a curve a channel, then a cube of 2 ** n corners in XYZ."""
    channels = int(np.log2(len(corners)))
    head = struct.pack(
        ">4sI4B9i", b"mft2", 0, channels, 3, 2, 0, *(65536 * v for v in (1, 0, 0, 0, 1, 0, 0, 0, 1))
    )
    codes = np.round(np.tile(curve, channels) * 65535)
    cube = np.round(np.clip(corners / (1 + 32767 / 32768), 0, 1) * 65535)
    words = np.concatenate([codes, cube.ravel(), np.tile([0, 65535], 3)]).astype(">u2")
    return _profile(kind, {b"A2B0": head + struct.pack(">HH", len(curve), 2) + words.tobytes()})


def to_xyz(space: tuple) -> np.ndarray:
    """Return (3, 3), linear RGB of primaries and a white point (xy) -> XYZ under D50."""
    primaries, white = space
    columns = np.array([_xyz(xy) for xy in primaries]).T
    scaled = columns * np.linalg.solve(columns, _xyz(white))
    to_d50 = np.linalg.inv(BRADFORD) @ np.diag(BRADFORD @ D50 / (BRADFORD @ _xyz(white))) @ BRADFORD
    return to_d50 @ scaled


def grey_profile(curve: bytes) -> bytes:
    """Return a display profile of a grey picture."""
    return _profile(b"GRAY", {b"kTRC": curve})


def _xyz(xy: tuple[float, float]) -> np.ndarray:
    x, y = xy
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _xyz_tag(xyz: Sequence[float]) -> bytes:
    return struct.pack(">4sI3i", b"XYZ ", 0, *(round(v * 65536) for v in xyz))


def _profile(space: bytes, tags: dict[bytes, bytes]) -> bytes:
    description = b"test\0"
    tags = {
        b"desc": struct.pack(">4sII", b"desc", 0, len(description)) + description + bytes(78),
        b"wtpt": _xyz_tag(D50),
        **tags,
    }
    start = 128 + 4 + 12 * len(tags)
    entries, body = b"", b""
    for name, data in tags.items():
        entries += struct.pack(">4sII", name, start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    header = struct.pack(
        ">I4sI4s4s4s12s4s4sI4s4sQI3i48x",
        *(start + len(body), b"lcms", 0x02400000, b"mntr", space, b"XYZ ", bytes(12), b"acsp", bytes(4), 0),
        *(bytes(4), bytes(4), 0, 1, *(round(v * 65536) for v in D50)),
    )
    return header + struct.pack(">I", len(tags)) + entries + body
