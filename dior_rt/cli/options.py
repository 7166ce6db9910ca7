"""The options that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer


def _share(text: str) -> float:
    """A number, or a fraction such as 0.5/255."""
    above, bar, below = text.partition("/")
    try:
        share = float(above) / (float(below) if bar else 1)
    except (ValueError, ZeroDivisionError):
        share = math.nan
    if not math.isfinite(share):
        raise typer.BadParameter(f"{text[:40]!r} is no number and no fraction such as 0.5/255.")
    return share


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


Photo = Annotated[Path, typer.Argument(metavar="PHOTO", help="A PNG, JPEG, TIFF or WebP picture ...")]
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
Preset = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="reference, balanced or fast; what else is given goes over it [default: reference].",
    ),
]
Solver = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="euler, heun, adams, dpmpp-2m or unipc [default: the preset's]."),
]
Shift = Annotated[
    float | None,
    typer.Option(callback=_finite, help="Above 1, more of the steps are near noise [default: the model's]."),
]
Interval = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LOW HIGH", help="Guidance acts only between these sigmas [default: 0 1]."),
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        parser=_share,
        metavar="ERROR",
        help="Take as many steps as keep the picture's error below this, such as 0.5/255.",
    ),
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
Reach = Annotated[
    float | None,
    typer.Option(
        callback=_finite,
        help="How far from the strokes light changes, as a share of the photo's longer side; 0.1 paints one "
        "lamp and leaves the rest [default: as far as the model takes it].",
    ),
]
Format = Annotated[
    Literal["png", "jpg", "tif", "webp", "exr", "jxl"] | None,
    typer.Option(
        help="The kind of file to write [default: by the name of OUT, else png, tif for camera raw, or exr "
        "for EXR]."
    ),
]
Quality = Annotated[
    int | None,
    typer.Option(min=1, max=100, help="Of JPEG, WebP and JPEG XL [default: 95; JPEG XL keeps every pixel]."),
]
Bits = Annotated[
    Literal["8", "16", "32"] | None,
    typer.Option(help="Bits a channel; 16 also computes in 16 [default: as the photo has them]."),
]
Sidecar = Annotated[
    bool, typer.Option("--sidecar", help="Write how the picture was made into an .xmp file beside it.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a result that is there already.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Page = Annotated[
    int,
    typer.Option(min=0, max=999, help="Which page of STROKES is read where it has several; 0 is the first."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object that says what was done.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
