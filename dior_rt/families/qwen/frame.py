"""Place a photo in the picture that the model sees, so that the result is aligned to the pixel.

The model needs sides that are multiples of 32 and about 1024 x 1024 pixels. Models of this family shift and
zoom a stretched photo. So the photo keeps its shape as the content of a canvas. The rest of the canvas is
filled with the content's mirror image, and the result is cut from the same place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def fit_area(area: int, height: int, width: int, multiple: int) -> tuple[int, int]:
    """Return (rows, columns): multiples of `multiple`, with about `area` pixels and the ratio height :
    width."""
    columns = math.sqrt(area * (width / height))
    rows = columns / (width / height)
    return max(1, round(rows / multiple)) * multiple, max(1, round(columns / multiple)) * multiple


def fit_content(area: int, height: int, width: int, multiple: int) -> tuple[int, int]:
    """Return (rows, columns) of the content: the photo's shape, as large as the size of `fit_area` allows."""
    rows, columns = fit_area(area, height, width, multiple)
    scale = min(rows / height, columns / width)
    return max(1, round(height * scale)), max(1, round(width * scale))


@dataclass(frozen=True)
class Frame:
    """A canvas with the content in its middle: (rows, columns) of each, and the content's corner."""

    canvas: tuple[int, int]
    content: tuple[int, int]
    corner: tuple[int, int]

    @classmethod
    def around(cls, content: tuple[int, int], multiple: int) -> Frame:
        """Return the smallest canvas whose sides are multiples of `multiple`."""
        rows, columns = (-(-side // multiple) * multiple for side in content)
        return cls((rows, columns), content, ((rows - content[0]) // 2, (columns - content[1]) // 2))

    def pad(self, content: NDArray[np.uint8], mirror: bool) -> NDArray[np.uint8]:
        """Lay content (h, w, 3) on the canvas, surrounded by its mirror image or by black."""
        after = (self.canvas[i] - self.content[i] - self.corner[i] for i in (0, 1))
        around = [*zip(self.corner, after, strict=True), (0, 0)]
        return np.pad(content, around, mode="symmetric" if mirror else "constant")

    def crop(self, canvas: NDArray[np.float32]) -> NDArray[np.float32]:
        """Cut the content (h, w, 3) out of a canvas."""
        (top, left), (rows, columns) = self.corner, self.content
        return canvas[top : top + rows, left : left + columns]


def shrink(pixels: NDArray, size: tuple[int, int]) -> NDArray[np.float32]:
    """Resize an sRGB picture (h, w, 3), uint8, uint16 or float32, by Lanczos. Return it in 0..1.

    8-bit pictures are resized in 8 bits, as diffusers' processor does.
    """
    if pixels.dtype == np.uint8:
        return resize(pixels, size, Image.Resampling.LANCZOS).astype(np.float32) / np.float32(255)
    whole = np.float32(np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1)
    return resize(pixels / whole, size, Image.Resampling.LANCZOS).clip(0, 1)


def resize(pixels: NDArray, size: tuple[int, int], method: Image.Resampling) -> NDArray:
    """Resize (h, w, 3), uint8 or float32, to (rows, columns) as Pillow does. The same size is returned
    unchanged."""
    if pixels.shape[:2] == size:
        return pixels
    if pixels.dtype == np.uint8:
        return np.asarray(Image.fromarray(pixels).resize(size[::-1], method))
    planes = [Image.fromarray(plane).resize(size[::-1], method) for plane in np.moveaxis(pixels, -1, 0)]
    return np.stack([np.asarray(plane) for plane in planes], axis=-1)
