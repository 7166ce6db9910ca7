"""The photographer's sheet: lighting ideas on real photos, to be looked at.

    {ideas}/ideas.json             [{"photo": name, "idea": words, "strokes": file}, ...]
    {ideas}/{strokes}              strokes as `dior-rt relight` reads them

A photo's name is one of `subjects`. The sheet has a row for each photo: the photo, then each idea with its
strokes and its result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from dior_rt.errors import InputError
from dior_rt.files import make_folder, reason, replacing
from dior_rt.images.photo import Photo as Picture
from dior_rt.images.photo import write_photo
from dior_rt.images.strokes import read_strokes
from dior_rt.kernels import Stroke
from dior_rt.records import parse, read_json
from dior_rt.relight import Relighter
from dior_rt.training.evaluation.judges.subjects import CLONE, find_photo
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.metrics import Photo
from dior_rt.training.evaluation.tasks import OPS

IDEAS: Final = CLONE / "docs" / "sheet"
CELL: Final = 340  # pixels of a picture's longer side on the sheet
GAP: Final = 6
LINE: Final = 14  # height of a line of text
SHEET: Final = "sheet.jpg"


@dataclass(frozen=True)
class Idea:
    """photo: a name that `find_photo` knows. idea: what the photographer wants. strokes: a file's name."""

    photo: str
    idea: str
    strokes: str


def read_ideas(folder: Path = IDEAS) -> list[Idea]:
    """Read the list of ideas. Raises InputError."""
    path = folder / "ideas.json"
    try:
        return list(parse(tuple[Idea, ...], read_json(path, 1 << 20)))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the ideas {path}: {reason(error)}.") from error


def make_sheet(
    bundle: Path,
    out: Path,
    steps: int | None = None,
    ideas: Path = IDEAS,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write each idea's result to {out}/{strokes}.png, and all to {out}/sheet.jpg. Raises InputError."""
    listed = read_ideas(ideas)
    relighter = Relighter(bundle)
    make_folder(out)
    rows, done = [], 0
    for photo, group in groupby(listed, lambda idea: idea.photo):
        source = read_picture(find_photo(photo))
        cells = [(Path(photo.rpartition(":")[2]).stem, source)]
        for idea in group:
            drawn = read_strokes(ideas / idea.strokes, (source.shape[0], source.shape[1]))
            if not isinstance(drawn, list):
                raise InputError(f"{idea.strokes} is no JSON. Ideas are strokes drawn as lines.")
            strokes = [one for one in drawn if isinstance(one, Stroke)]
            if len(strokes) < len(drawn):
                raise InputError(f"{idea.strokes} blends its strokes. Ideas are strokes that set the light.")
            result = np.asarray(relighter.relight(source, strokes, steps=steps).picture)
            write_photo(out / f"{Path(idea.strokes).stem}.png", Picture(result), {})
            cells += [(idea.idea, marked(source, strokes)), ("", result)]
            done += 1
            if progress:
                progress(done, len(listed))
        rows.append(cells)
    with replacing(out / SHEET) as file:
        contact(rows).save(file, "JPEG", quality=88)


def marked(photo: Photo, drawn: list[Stroke]) -> Photo:
    """Return the photo, darkened, with the strokes over it as the light that they hold.

    Light brighter than display white is dimmed to it, so that its hue shows.
    """
    strokes = OPS.draw_strokes(drawn, (photo.shape[0], photo.shape[1]))
    light = strokes.light / np.maximum(strokes.light.max(axis=2, keepdims=True), 1)
    shown = OPS.encode_srgb(light, np.uint8).astype(np.float32)
    mask = strokes.mask[..., None]
    return np.asarray(photo * 0.4 * (1 - mask) + shown * mask, np.uint8)


def contact(rows: Sequence[Sequence[tuple[str, Photo]]]) -> Image.Image:
    """Lay out rows of labelled pictures."""
    small = [[(words, _fit(picture)) for words, picture in row] for row in rows]
    heights = [LINE + max(cell.height for _, cell in row) + GAP for row in small]
    width = max(len(row) for row in small) * (CELL + GAP)
    sheet, top = Image.new("RGB", (width, sum(heights)), "white"), 0
    pen = ImageDraw.Draw(sheet)
    for row, height in zip(small, heights, strict=True):
        for column, (words, cell) in enumerate(row):
            pen.text((column * (CELL + GAP), top), words, fill="black")
            sheet.paste(cell, (column * (CELL + GAP), top + LINE))
        top += height
    return sheet


def _fit(picture: Photo) -> Image.Image:
    cell = Image.fromarray(picture)
    cell.thumbnail((CELL, CELL))
    return cell
