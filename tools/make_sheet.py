"""Make docs/pictures/sheet.jpg: one warm, one blue and one dark stroke on each of some real photos.

python -m tools.make_sheet [PHOTO ...]

Takes the photos that come with scikit-image, scikit-learn and matplotlib (`pip install scikit-learn`, too),
and those named. Each row: the photo with all three strokes on it, and relit under each of them alone.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image, ImageDraw

from dior_rt import Relighter
from dior_rt.errors import InputError
from dior_rt.kernels import Stroke
from tools.command import start

SHEET = Path("docs/pictures/sheet.jpg")
PACKAGED = (
    ("skimage", "data/astronaut.png"),
    ("matplotlib", "mpl-data/sample_data/grace_hopper.jpg"),
    ("skimage", "data/chelsea.png"),
    ("skimage", "data/coffee.png"),
    ("sklearn", "datasets/images/china.jpg"),
    ("sklearn", "datasets/images/flower.jpg"),
    ("skimage", "data/rocket.jpg"),
)
SIZE = (420, 300)  # of a photo on the sheet, at most
GAP = 6


def strokes(width: int, height: int) -> list[Stroke]:
    """Warm light down the left side, blue light down the right, and darkness in the middle."""
    brush = 0.12 * min(width, height)
    left, right = 0.18 * width, 0.82 * width
    return [
        Stroke(((left, 0.3 * height), (left, 0.7 * height)), brush, (1.0, 0.6, 0.25), 1.5),
        Stroke(((right, 0.3 * height), (right, 0.7 * height)), brush, (0.2, 0.4, 1.0), 1.5),
        Stroke(((0.5 * width, 0.5 * height), (0.5 * width, 0.65 * height)), brush, (1.0, 1.0, 1.0), 0.02),
    ]


def marked(photo: Image.Image, drawn: list[Stroke]) -> Image.Image:
    """The photo with the strokes' paths on it, in their colours."""
    shown = photo.copy()
    pen = ImageDraw.Draw(shown)
    for stroke in drawn:
        lit = np.array(stroke.color) * min(stroke.intensity, 1.0)
        colour = tuple(int(v) for v in 255 * lit ** (1 / 2.2))
        pen.line(stroke.points, fill=colour, width=max(2, round(stroke.width / 3)))
    return shown


def row(relighter: Relighter, path: Path) -> list[Image.Image]:
    photo = Image.open(path).convert("RGB")
    drawn = strokes(photo.width, photo.height)
    relit = [Image.fromarray(relighter.relight(np.asarray(photo), [stroke]).picture) for stroke in drawn]
    cells = [marked(photo, drawn), *relit]
    for cell in cells:
        cell.thumbnail(SIZE)
    return cells


def main(
    photos: Annotated[list[Path] | None, typer.Argument(help="More photos, below those of packages.")] = None,
) -> None:
    """Make docs/pictures/sheet.jpg: one warm, one blue and one dark stroke on each of some real photos."""
    paths = []
    for package, inside in PACKAGED:
        spec = find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            raise InputError(f"The package {package} is not there; see the first lines of {__file__}.")
        paths.append(Path(spec.submodule_search_locations[0]) / inside)
    relighter = Relighter()
    rows = [row(relighter, path) for path in [*paths, *(photos or ())]]
    heights = [cells[0].height + GAP for cells in rows]
    sheet = Image.new("RGB", (4 * (SIZE[0] + GAP), sum(heights)), "white")
    for top, cells in zip(np.cumsum([0, *heights]), rows, strict=False):
        for k, cell in enumerate(cells):
            sheet.paste(cell, (k * (SIZE[0] + GAP), int(top)))
    sheet.save(SHEET, quality=85)


if __name__ == "__main__":
    start(main)
