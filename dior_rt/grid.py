"""The light grid: the small raster on which light is predicted, shaped like the photo."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GridRule:
    """The rule for the size of a photo's light grid.

    cells: the approximate number of cells. multiple: both sides are multiples of it (the network's patch).
    longest: the longest side allowed, however elongated the photo is.
    """

    cells: int = 4096
    multiple: int = 4
    longest: int = 256

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """Return the (rows, columns) of the grid of a photo of height x width pixels, nearest to its aspect
        ratio.

        >>> GridRule().shape(1000, 1000), GridRule().shape(2000, 3000), GridRule().shape(1, 4000)
        ((64, 64), (52, 80), (4, 256))
        """
        if height < 1 or width < 1:
            raise ValueError(f"a photo of {height} x {width} pixels has no light grid")
        aspect = math.sqrt(width / height)
        side = math.sqrt(self.cells)
        return self._side(side / aspect), self._side(side * aspect)

    def _side(self, length: float) -> int:
        steps = round(length / self.multiple)
        return max(self.multiple, min(self.longest, steps * self.multiple))
