"""Rotary positions: the rotation of each pair of a head's numbers, as cos and sin tables (tokens, head /
2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def rates(width: int, theta: float) -> Array:
    """Return theta^(-2 i / width) for i < width / 2: radians per position (Su et al., arXiv 2104.09864)."""
    exponents = np.arange(0, width, 2, dtype=np.float32) / np.float32(width)
    return (1 / np.power(np.float32(theta), exponents)).astype(np.float32)


def turns(places: NDArray[np.int64], widths: Sequence[int], theta: float) -> tuple[Array, Array]:
    """Return cos and sin for tokens at `places` (tokens, axes). Axis k rotates widths[k] of a head's
    numbers."""
    angles = [
        np.outer(places[:, k].astype(np.float32), rates(width, theta)) for k, width in enumerate(widths)
    ]
    joined = np.concatenate(angles, axis=1)
    return np.cos(joined), np.sin(joined)


def joint_places(text: int, pictures: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    """Return positions (frame, row, column) of `text` words, then of the tokens of pictures (rows, columns).

    Picture k is frame k, and its rows and columns are counted from its centre. Words follow on the
    diagonal, beyond the edge of the largest picture.
    """
    first = max(max(rows // 2, columns // 2) for rows, columns in pictures)
    words = np.repeat(np.arange(first, first + text)[:, None], 3, axis=1)
    tokens = [
        grid_places(rows, columns, frame=k, middle=(rows - rows // 2, columns - columns // 2))
        for k, (rows, columns) in enumerate(pictures)
    ]
    return np.concatenate([words, *tokens])


def grid_places(rows: int, columns: int, frame: int, middle: tuple[int, int] = (0, 0)) -> NDArray[np.int64]:
    """Return (frame, row, column) of a grid's tokens, row by row, counted from `middle`."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([np.full(rows * columns, frame), y.ravel() - middle[0], x.ravel() - middle[1]], axis=1)
