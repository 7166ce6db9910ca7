"""Write the results of an evaluation: Markdown, JSON, and a contact sheet of pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from dior_rt.files import make_folder, replacing
from dior_rt.training.evaluation.methods import Settings
from dior_rt.training.evaluation.metrics import Photo
from dior_rt.training.evaluation.results import Control, Evaluation, Example, Figure, Row, Table
from dior_rt.training.evaluation.tasks import OPS

CELL: Final = 192  # pixels of the longer side of a picture on the contact sheet
GAP: Final = 6
LINE: Final = 14  # height of a line of text
UNSPECIFIED: Final = 128  # grey for places that strokes leave unspecified
COLUMNS: Final = ("source", "strokes", "result", "truth")
DECIMALS: Final = {"PSNR": 2, "RMSE": 1}  # three digits for all others


def write_report(folder: Path, evaluation: Evaluation, examples: Sequence[Example]) -> None:
    """Write report.json, report.md and contact.png, each complete or not at all. Raises InputError."""
    make_folder(folder)
    for name, text in (("report.json", as_json(evaluation)), ("report.md", markdown(evaluation))):
        with replacing(folder / name) as file:
            file.write((text + "\n").encode())
    with replacing(folder / "contact.png") as file:
        contact_sheet(examples).save(file, "PNG")


def as_json(evaluation: Evaluation) -> str:
    """Return every figure, unrounded."""
    return json.dumps(asdict(evaluation), indent=2)


def markdown(evaluation: Evaluation) -> str:
    """Return tables of means with 95 % intervals, and a few lines about the brush."""
    return "\n\n".join(_sections(evaluation))


def _sections(evaluation: Evaluation) -> Iterator[str]:
    settings = f": {_settings(evaluation.settings)}" if evaluation.settings else ""
    yield f"**{evaluation.method}**{settings}"
    for table in evaluation.tables:
        yield _table(table)
    if evaluation.control:
        yield "\n".join(f"- {line}" for line in _control(evaluation.control))
    if borders := evaluation.borders:
        yield (
            f"- differences across patch borders over those inside, {borders.photos} photos: "
            f"{borders.relit:.3f} in relit light, {borders.estimated:.3f} in estimated light"
        )


def _settings(used: Settings) -> str:
    reach = f", reach {used.reach:g}" if used.reach else ""
    return f"{used.steps} steps, guidance {used.guidance:g}, noise {used.noise_scale:g}{reach}"


def _table(table: Table) -> str:
    names = list(table.rows[0].figures)
    lines = [
        f"{table.benchmark}, {table.pictures} pictures. {table.control}",
        "",
        f"| method | control | {' | '.join(names)} | seconds |",
        "|---" * (len(names) + 3) + "|",
        *(_line(row) for row in table.rows),
    ]
    if table.estimate:
        figure = table.estimate
        lines += ["", f"Estimated map of the source, best scale: {_figure('PSNR', figure)} dB."]
    return "\n".join(lines)


def _line(row: Row) -> str:
    seconds = "" if row.seconds is None else f"{row.seconds:.2f}"
    figures = (_figure(name, figure) for name, figure in row.figures.items())
    return f"| {' | '.join([row.method, row.control, *figures, seconds])} |"


def _figure(name: str, figure: Figure) -> str:
    places = DECIMALS.get(name.split()[0].removeprefix("SI-"), 3)
    return f"{figure.mean:.{places}f} ({figure.low:.{places}f} to {figure.high:.{places}f})"


def _control(control: Control) -> Iterator[str]:
    answer, chroma = control.response, control.chroma
    yield (
        f"light under a dab follows its intensity to the power {answer.slope:.2f}; "
        f"{answer.monotonic:.0%} of {answer.dabs} rise with every step"
    )
    yield f"change far from the strongest dab: {answer.leakage:.1%} of that under it"
    yield (
        f"saturated dabs: {chroma.chromaticity:.1f} degrees of chromaticity from the surface under them, "
        f"the added light's hue {chroma.hue:.0f} degrees from the dab's"
    )
    if control.progress:
        yield (
            f"{control.progress.not_worse:.0%} of further true strokes do not make the picture worse; "
            f"first to last stroke {control.progress.gain:+.2f} dB"
        )
    yield f"unchanged light, where no stroke speaks: {control.keep_psnr:.1f} dB to the photo"
    yield f"one light added, where it changes nothing: {control.add_psnr:.1f} dB to the photo"


def contact_sheet(examples: Sequence[Example]) -> Image.Image:
    """Return a row per task: source, strokes (grey where unspecified), result, truth."""
    rows = [[_cell(picture) for picture in _pictures(example)] for example in examples]
    height = LINE + sum(row[0].height + LINE + GAP for row in rows)
    sheet = Image.new("RGB", (len(COLUMNS) * (CELL + GAP) + GAP, height), "white")
    pen, top = ImageDraw.Draw(sheet), LINE
    for number, column in enumerate(COLUMNS):
        pen.text((GAP + number * (CELL + GAP), 0), column, fill="black")
    for row, example in zip(rows, examples, strict=True):
        pen.text((GAP, top), example.task.name, fill="gray")
        for number, picture in enumerate(row):
            sheet.paste(picture, (GAP + number * (CELL + GAP), top + LINE))
        top += row[0].height + LINE + GAP
    return sheet


def _cell(picture: Photo) -> Image.Image:
    """Return a picture that fits a cell. Smaller pictures are enlarged by a whole factor."""
    cell = Image.fromarray(picture)
    if (times := CELL // max(cell.size)) > 1:
        return cell.resize((times * cell.width, times * cell.height), Image.Resampling.NEAREST)
    cell.thumbnail((CELL, CELL))
    return cell


def _pictures(example: Example) -> tuple[Photo, Photo, Photo, Photo]:
    task = example.task
    drawn = np.full_like(task.source, UNSPECIFIED)
    if example.strokes:
        shown = OPS.encode_srgb(example.strokes.light, np.uint8)
        shown[example.strokes.mask == 0] = UNSPECIFIED
        size = task.source.shape[1], task.source.shape[0]
        drawn = np.asarray(Image.fromarray(shown).resize(size, Image.Resampling.NEAREST))
    return task.source, drawn, example.result, task.truth
