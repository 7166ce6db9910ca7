"""The sRGB curve of IEC 61966-2-1: its definition in float64, and the tables that every device reads.

    decode(v) = v / 12.92                     for v <= 0.04045,      ((v + 0.055) / 1.055) ** 2.4   above
    encode(x) = 12.92 * x                     for x <= 0.0031308,    1.055 * x ** (1 / 2.4) - 0.055 above

Both continue beyond 0..1 with the same formulas: the line below 0, the power above 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.types import FloatArray

#: Where the line meets the power: the encoded value and the linear value.
ENCODED_KNEE = 0.04045
LINEAR_KNEE = 0.0031308


def srgb_to_linear(encoded: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return decode(v) in float64."""
    v = np.asarray(encoded, np.float64)
    power = ((np.maximum(v, ENCODED_KNEE) + 0.055) / 1.055) ** 2.4
    return np.where(v <= ENCODED_KNEE, v / 12.92, power)


def linear_to_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return encode(x) in float64."""
    x = np.asarray(linear, np.float64)
    power = 1.055 * np.maximum(x, LINEAR_KNEE) ** (1 / 2.4) - 0.055
    return np.where(x <= LINEAR_KNEE, 12.92 * x, power)


@cache
def decode_table(dtype: np.dtype[np.unsignedinteger]) -> FloatArray:
    """Return the linear value of every code of uint8 or uint16 as float32."""
    codes = np.arange(np.iinfo(dtype).max + 1)
    table = srgb_to_linear(codes / codes[-1]).astype(np.float32)
    table.setflags(write=False)
    return table


@dataclass(frozen=True)
class EncodeTable:
    """A table that rounds linear float32 to the nearest sRGB code, exactly and without computing a power.

    The upper bits of a float select a bucket so narrow that it holds at most one border between two codes.
    With the bits of x, clipped to floor..1, in 32-bit integers that wrap around,

        code = (entry[(bits(x) >> shift) - first] + bits(x)) >> shift

    The entry is the bucket's lower code << shift, minus the bits at which the bucket begins, plus an offset
    that makes the sum carry into the next code from the border on.
    """

    shift: int
    first: int
    floor: np.float32
    entry: npt.NDArray[np.int32]


@cache
def encode_table(dtype: np.dtype[np.unsignedinteger]) -> EncodeTable:
    """Return the table for uint8 or uint16."""
    top = int(np.iinfo(dtype).max)
    exact = srgb_to_linear((np.arange(top) + 0.5) / top)
    # border[k]: the bits of the smallest float32 that rounds to code k + 1. For floats >= 0, larger floats
    # have larger bits.
    border = exact.astype(np.float32).view(np.int32)
    border += border.view(np.float32) < exact
    shift = 16 if top == 255 else 8
    floor = np.float32(2.0 ** np.floor(np.log2(exact[0])))
    first = int(floor.view(np.int32)) >> shift
    begin = np.arange(first, (int(np.float32(1).view(np.int32)) >> shift) + 1, dtype=np.int64) << shift
    code = np.searchsorted(border, begin, side="right")
    carry = begin + (1 << shift) - np.append(border, np.iinfo(np.int32).max)[code]
    entry = ((code << shift) - begin + np.maximum(carry, 0)).astype(np.int32)
    entry.setflags(write=False)
    return EncodeTable(shift, first, floor, entry)
