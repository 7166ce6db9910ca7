"""Make docs/pictures: before, strokes, after, for the example photos. Run it from the repository's root:

python -m tools.make_pictures [BUNDLE]
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image

from dior_rt import Relighter
from dior_rt.images.strokes import read_strokes
from dior_rt.kernels import NumpyOps, Stroke
from tools.command import start

EXAMPLES = Path("examples")
PICTURES = Path("docs/pictures")
PAIRS = (
    ("coffee.jpg", "coffee-strokes.json"),
    ("astronaut.jpg", "astronaut-strokes.png"),
    ("chelsea.jpg", "chelsea-strokes.json"),
)
GAP = 8


def overlay(photo: Image.Image, strokes: NDArray | list[Stroke]) -> Image.Image:
    """The strokes laid over a dimmed photo, in their own colours, clipped to what can be shown."""
    if isinstance(strokes, list):
        ops = NumpyOps()
        drawn = ops.draw_strokes(strokes, (photo.height, photo.width))
        light, mask = ops.encode_srgb(drawn.light, np.uint8), drawn.mask[..., None]
    else:
        light, mask = strokes[..., :3], strokes[..., 3:] / 255
    dimmed = np.asarray(photo.convert("L").convert("RGB")) * 0.5
    return Image.fromarray(np.uint8(dimmed * (1 - mask) + light * mask))


def side_by_side(pictures: list[Image.Image]) -> Image.Image:
    height = pictures[0].height
    sheet = Image.new("RGB", (sum(p.width for p in pictures) + GAP * (len(pictures) - 1), height), "white")
    left = 0
    for picture in pictures:
        sheet.paste(picture, (left, 0))
        left += picture.width + GAP
    return sheet


def main(
    bundle: Annotated[Path | None, typer.Argument(help="The model [default: the one that ships].")] = None,
) -> None:
    """Make docs/pictures: before, strokes, after, for the example photos."""
    relighter = Relighter(bundle)
    PICTURES.mkdir(parents=True, exist_ok=True)
    for photo_name, strokes_name in PAIRS:
        photo = Image.open(EXAMPLES / photo_name).convert("RGB")
        strokes = read_strokes(EXAMPLES / strokes_name, (photo.height, photo.width))
        relit = relighter.relight(photo, strokes).picture
        sheet = side_by_side([photo, overlay(photo, strokes), relit])
        sheet.thumbnail((1500, 1500))
        sheet.save(PICTURES / photo_name, quality=88)


if __name__ == "__main__":
    start(main)
