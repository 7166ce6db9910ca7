"""Ops: the pixel operations, with their definitions and checks. Subclasses compute them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from dior_rt.kernels.sparsify import Discs, Lattice, draw_lattice, draw_walks
from dior_rt.kernels.transfer import nodes
from dior_rt.kernels.types import FloatArray, Picture, Stroke, Strokes

Mode = Literal["strokes", "coarse", "dense"]
Grid = tuple[int, int]
Dtype = npt.DTypeLike


class Ops(ABC):
    """The operations. Every method raises ValueError for a wrong shape, dtype or option.

    Pictures are uint8, uint16 or float32, sRGB-encoded; integers span 0..1 over their whole range. Light is
    float32 and linear; 1.0 is display white. Arrays need not be contiguous. Results are contiguous and
    always new.

    name: the device that computes. reason: why it was chosen, in one sentence. notice: what the user should
    know of the choice, in one sentence, or "".
    """

    name: str
    reason: str = "it was requested"
    notice: str = ""

    def decode_srgb(self, picture: Picture) -> FloatArray:
        """Convert sRGB to linear, any shape. Floats outside 0..1 follow the extended curve; NaN stays NaN."""
        picture = np.asarray(picture)
        _check_dtype("picture", picture)
        return self._decode(picture)

    def encode_srgb(self, linear: FloatArray, dtype: Dtype) -> Picture:
        """Convert linear float32 of any shape to sRGB of `dtype`.

        Integers are exactly the nearest code of the value clipped to 0..1; NaN becomes 0. Floats are not
        clipped.
        """
        linear, wanted = np.asarray(linear), np.dtype(dtype)
        if linear.dtype != np.float32:
            raise ValueError(f"linear light must be float32, not {linear.dtype}")
        if wanted not in (np.uint8, np.uint16, np.float32):
            raise ValueError(f"a picture must be uint8, uint16 or float32, not {wanted}")
        return self._encode(linear, wanted)

    def reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        """Reduce sRGB (H, W, 3) to linear (h, w, 3): the mean over the exact area of each cell, in linear
        light."""
        picture = np.asarray(picture)
        _check_dtype("picture", picture)
        _check_pixels("picture", picture, channels=3)
        return self._reduce_photo(picture, _check_size(grid))

    def reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        """Reduce full-size strokes to the grid: the mean of light, weighted by mask and exact overlap.

        light (H, W, 3): integers are sRGB-encoded, floats linear. mask (H, W), in 0..1: integers span
        that range, and values that are not 0 count as at least 2^-60. Light where the mask is 0 never
        enters a result. The new mask is 1 in each cell that a specified pixel touches, else 0.
        """
        light, mask = np.asarray(light), np.asarray(mask)
        _check_dtype("light", light)
        _check_dtype("mask", mask)
        _check_pixels("light", light, channels=3)
        _check_pixels("mask", mask, size=light.shape[:2])
        if mask.dtype == np.float32 and not (mask.min() >= 0 and mask.max() <= 1):
            raise ValueError("a mask must lie in 0..1")
        return self._reduce_strokes(light, mask, _check_size(grid))

    def draw_strokes(self, strokes: Sequence[Stroke], size: Grid) -> Strokes:
        """Rasterise strokes, later ones over earlier ones. `dior_rt.kernels.draw` has the equation."""
        return self._draw_strokes(list(strokes), _check_size(size))

    def sparsify(
        self, lumi: FloatArray, mode: Mode, seed: int, interest: FloatArray | None = None
    ) -> Strokes:
        """Return the part of a dense Lumi map (H, W, 3) that a person might have drawn.

        The mask is 0 or 1, and never 0 everywhere. A seed (an int >= 0) gives the same mask on every device,
        bit for bit. The modes are

            dense    everything
            strokes  one to eight freehand strokes, under which each pixel keeps its value. They start
                     alternately in bright and dark regions, or in proportion to `interest` (H, W) >= 0 unless
                     that is 0 everywhere
            coarse   the map at a random coarser resolution, without a random share of the cells; a cell holds
                     the mean of its pixels
        """
        lumi = np.asarray(lumi)
        if lumi.dtype != np.float32:
            raise ValueError(f"a Lumi map must be float32, not {lumi.dtype}")
        _check_pixels("Lumi map", lumi, channels=3)
        if mode not in get_args(Mode):
            raise ValueError(f"the mode must be one of {', '.join(get_args(Mode))}, not {mode!r}")
        if interest is not None:
            interest = np.asarray(interest, np.float32)
            _check_pixels("interest", interest, size=lumi.shape[:2])
            if not (interest.min() >= 0 and np.isfinite(interest.max())):
                raise ValueError("interest must be finite and >= 0")
        if mode == "dense":
            return Strokes(lumi.copy(), np.ones(lumi.shape[:2], np.float32))
        if mode == "coarse":
            height, width = lumi.shape[:2]
            return self._coarsen(lumi, draw_lattice(height, width, seed))
        return self._cut(lumi, draw_walks(lumi, seed, interest))

    def transfer(self, photo: Picture, source: FloatArray, relit: FloatArray) -> Picture:
        """Return the photo (H, W, 3) under the light that turns the grid `source` into `relit`, in its own
        dtype.

        source, relit: (h, w, 3) float32, linear, finite, >= 0. source is `reduce_photo` of the photo. Where
        the grids are equal, an integer photo is returned unchanged, bit for bit. `dior_rt.kernels.transfer`
        has the equation.
        """
        photo, source, relit = np.asarray(photo), np.asarray(source), np.asarray(relit)
        _check_dtype("photo", photo)
        _check_pixels("photo", photo, channels=3)
        for name, grid in (("source", source), ("relit", relit)):
            if grid.dtype != np.float32:
                raise ValueError(f"the {name} grid must be float32, not {grid.dtype}")
            _check_pixels(f"{name} grid", grid, channels=3)
            if not (grid.min() >= 0 and np.isfinite(grid.max())):
                raise ValueError(f"the {name} grid must be finite and >= 0")
        if source.shape != relit.shape:
            raise ValueError(f"the grids differ: source {source.shape[:2]}, relit {relit.shape[:2]}")
        return self._transfer(photo, nodes(source, relit))

    @abstractmethod
    def _decode(self, picture: Picture) -> FloatArray: ...

    @abstractmethod
    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture: ...

    @abstractmethod
    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray: ...

    @abstractmethod
    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes: ...

    @abstractmethod
    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes: ...

    @abstractmethod
    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes: ...

    @abstractmethod
    def _cut(self, lumi: FloatArray, discs: Discs) -> Strokes: ...

    @abstractmethod
    def _transfer(self, photo: Picture, nodes: FloatArray) -> Picture: ...


def _check_dtype(name: str, array: np.ndarray) -> None:
    if array.dtype not in (np.uint8, np.uint16, np.float32):
        raise ValueError(f"{name} must be uint8, uint16 or float32, not {array.dtype}")


def _check_pixels(
    name: str, array: np.ndarray, channels: int | None = None, size: tuple[int, ...] | None = None
) -> None:
    """Raise unless the array is (H, W, channels), or (H, W) for channels None, and not empty."""
    wanted = "(H, W)" if channels is None else f"(H, W, {channels})"
    fits = array.ndim == 2 if channels is None else array.ndim == 3 and array.shape[2] == channels
    if not fits or array.size == 0:
        raise ValueError(f"{name} must have the shape {wanted} with at least one pixel, not {array.shape}")
    if size is not None and array.shape[:2] != size:
        raise ValueError(f"{name} must be {size[0]} x {size[1]}, not {array.shape[0]} x {array.shape[1]}")


def _check_size(size: Grid) -> Grid:
    height, width = (int(side) for side in size)
    if height < 1 or width < 1:
        raise ValueError(f"a size needs at least one row and one column, not {height} x {width}")
    return height, width
