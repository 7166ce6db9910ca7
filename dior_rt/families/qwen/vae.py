"""Run the image autoencoder in tiles, so that its memory does not grow with the picture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

TILE = 64  # latents per side: 512 pixels
OVERLAP = 16


def encode_tiled(
    encode: Callable[[Array], Array], pixels: Array, factor: int, tile: int = TILE, overlap: int = OVERLAP
) -> Array:
    """Encode pixels (1, 3, h, w) to latents (1, z, h / factor, w / factor). tile and overlap are in
    latents."""
    rows, columns = (side // factor for side in pixels.shape[2:])

    def part(y: slice, x: slice) -> Array:
        y, x = (slice(side.start * factor, side.stop * factor) for side in (y, x))
        return encode(np.ascontiguousarray(pixels[:, :, y, x]))

    return _blend(part, rows, columns, tile, overlap, scale=1)


def decode_tiled(
    decode: Callable[[Array], Array], latents: Array, factor: int, tile: int = TILE, overlap: int = OVERLAP
) -> Array:
    """Decode latents (1, z, h, w) to pixels (1, 3, factor h, factor w)."""
    rows, columns = latents.shape[2:]

    def part(y: slice, x: slice) -> Array:
        return decode(np.ascontiguousarray(latents[:, :, y, x]))

    return _blend(part, rows, columns, tile, overlap, scale=factor)


def _blend(
    part: Callable[[slice, slice], Array], rows: int, columns: int, tile: int, overlap: int, scale: int
) -> Array:
    """Join overlapping tiles, weighted by ramps that fall towards their edges. The weights sum to 1.

    part: returns the result for a rectangle of latents. scale: pixels of the result per latent. A single
    tile that covers everything is returned unchanged.
    """
    if rows <= tile and columns <= tile:
        return part(slice(0, rows), slice(0, columns))
    total: Array | None = None
    weight = np.zeros((rows * scale, columns * scale), np.float32)
    for y in _cuts(rows, tile, overlap):
        for x in _cuts(columns, tile, overlap):
            piece = part(y, x)
            if total is None:
                total = np.zeros((*piece.shape[:2], *weight.shape), np.float32)
            ramp = np.outer(_ramp(y, overlap * scale, scale), _ramp(x, overlap * scale, scale))
            area = tuple(slice(side.start * scale, side.stop * scale) for side in (y, x))
            total[:, :, *area] += piece * ramp
            weight[area] += ramp
    assert total is not None
    return total / weight


def _cuts(length: int, tile: int, overlap: int) -> list[slice]:
    """Return even, overlapping intervals of at most `tile` that cover the length."""
    if length <= tile:
        return [slice(0, length)]
    count = -(-(length - overlap) // (tile - overlap))
    starts = np.rint(np.linspace(0, length - tile, count)).astype(int).tolist()
    return [slice(start, start + tile) for start in starts]


def _ramp(cut: slice, overlap: int, scale: int) -> Array:
    """Return weights that rise over the overlap at the start of an interval, and fall at its end."""
    length = (cut.stop - cut.start) * scale
    places = np.arange(length, dtype=np.float32) + 0.5
    return np.minimum(np.minimum(places, length - places) / overlap, 1)
