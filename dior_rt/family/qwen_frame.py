"""How a photo lies in the picture that the model sees, so that the result comes back aligned to the pixel.

The model wants sides that are multiples of 32 and some 1024^2 pixels. Stretching the photo to such a size and the result
back would do, if this family of models did not answer a stretched picture with one that is shifted and zoomed. So the
photo keeps its shape and is padded by its mirror image; the result is cut out of the same place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def fit_area(area: int, height: int, width: int, multiple: int) -> tuple[int, int]:
    """(rows, columns): multiples of `multiple`, the product about `area`, the ratio about height : width."""
    columns = math.sqrt(area * (width / height))
    rows = columns / (width / height)
    return max(1, round(rows / multiple)) * multiple, max(1, round(columns / multiple)) * multiple


@dataclass(frozen=True)
class Frame:
    """A canvas, and the content in it that the photo becomes: (rows, columns) each, and the content's corner."""

    canvas: tuple[int, int]
    content: tuple[int, int]
    corner: tuple[int, int]

    @classmethod
    def around(cls, height: int, width: int, area: int, multiple: int) -> Frame:
        """The frame for a photo of height x width: the largest content of its shape, in the middle."""
        canvas = fit_area(area, height, width, multiple)
        scale = min(canvas[0] / height, canvas[1] / width)
        rows, columns = (max(1, round(side * scale)) for side in (height, width))
        return cls(canvas, (rows, columns), ((canvas[0] - rows) // 2, (canvas[1] - columns) // 2))

    def pad(self, content: NDArray[np.uint8], mirror: bool) -> NDArray[np.uint8]:
        """Lay content (h, w, 3) on the canvas, surrounded by its mirror image or by black."""
        after = (self.canvas[i] - self.content[i] - self.corner[i] for i in (0, 1))
        around = [*zip(self.corner, after, strict=True), (0, 0)]
        return np.pad(content, around, mode="symmetric" if mirror else "constant")

    def crop(self, canvas: NDArray[np.float32]) -> NDArray[np.float32]:
        """Cut the content (h, w, 3) out of a canvas."""
        (top, left), (rows, columns) = self.corner, self.content
        return canvas[top : top + rows, left : left + columns]


def resize(pixels: NDArray[np.uint8], size: tuple[int, int], filter: Image.Resampling) -> NDArray[np.uint8]:
    """Resize (h, w, 3) to (rows, columns) as Pillow does; unchanged where it has that size."""
    if pixels.shape[:2] == size:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(size[::-1], filter))
