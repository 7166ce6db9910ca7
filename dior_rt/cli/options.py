"""The options that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


Photo = Annotated[Path, typer.Argument(metavar="PHOTO", help="A PNG, JPEG, TIFF or WebP picture.")]
Bundle = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="The model [default: the one that ships with dior-rt].")
]
Device = Annotated[
    str, typer.Option(metavar="NAME", help="What runs the network: auto, or a name from `dior-rt devices`.")
]
Ops = Annotated[
    str, typer.Option(metavar="NAME", help="What works on pixels: auto, numpy, opencl or opencl:WHICH.")
]
Steps = Annotated[
    int | None,
    typer.Option(min=1, max=1000, help="Steps of the sampler [default: the model's own]."),
]
Guidance = Annotated[
    float | None,
    typer.Option(
        min=0, callback=_finite, help="How strictly the strokes are followed [default: the model's own]."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same picture on every device.")]
Intensity = Annotated[
    float, typer.Option(min=0, callback=_finite, help="Multiplies the light of all strokes.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object that says what was done.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
