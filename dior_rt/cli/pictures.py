"""The commands that turn pictures into pictures."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from dior_rt import __version__
from dior_rt.cli import options
from dior_rt.cli.pipes import standard_files
from dior_rt.cli.text import say
from dior_rt.errors import InputError
from dior_rt.files import check_free, is_same_file
from dior_rt.stopwatch import Stopwatch

if TYPE_CHECKING:
    from dior_rt.relight import Relighter


@standard_files
def relight(
    photo: options.Photo,
    strokes: Annotated[
        Path,
        typer.Argument(
            metavar="STROKES",
            help="The light: an RGBA PNG, an RGB picture, a float EXR or NPY map, a JSON list of strokes, or "
            "a project of the light desk (.dior).",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="OUT",
            help="PNG, JPEG, TIFF, WebP, EXR or JPEG XL; - is standard output [default: PHOTO-relit.png].",
        ),
    ] = None,
    bundle: options.Bundle = None,
    device: options.Device = "auto",
    ops: options.Ops = "auto",
    preset: options.Preset = None,
    steps: options.Steps = None,
    solver: options.Solver = None,
    shift: options.Shift = None,
    guidance: options.Guidance = None,
    interval: options.Interval = None,
    tolerance: options.Tolerance = None,
    seed: options.Seed = 0,
    intensity: options.Intensity = 1.0,
    reach: options.Reach = None,
    key: Annotated[
        Literal["black"] | None,
        typer.Option(help="Read what is exactly black in STROKES as unspecified; not for JPEG."),
    ] = None,
    page: options.Page = 0,
    format: options.Format = None,
    quality: options.Quality = None,
    bits: options.Bits = None,
    sidecar: options.Sidecar = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Relight PHOTO by the light drawn in STROKES.

    STROKES says how bright, and in which colour, white paper on the surface would be there: white is the
    brightest that the photo can show, black is no light. What it leaves open the model completes.

    \b
    An RGBA picture of the photo's shape: paint on a transparent layer.
      dior-rt relight photo.jpg strokes.png
    One warm stroke, three times as strong, into a TIFF:
      echo '[{"points": [[80, 120], [240, 300]], "width": 40, "color": "#ffb060"}]' > warm.json
      dior-rt relight photo.jpg warm.json --intensity 3 -o warm.tif
    One more lamp, and the rest of the photo as it is:
      dior-rt relight photo.jpg strokes.png --reach 0.1
    The lights of a project of the light desk, as `dior-rt desk` exports them:
      dior-rt relight photo.jpg photo.dior
    A picture whose black means "not drawn":
      dior-rt relight photo.jpg light.png --key black
    Fast, or within half a level of 255 of what all the steps would give:
      dior-rt relight photo.jpg strokes.png --preset fast
      dior-rt relight photo.jpg strokes.png --tolerance 0.5/255
    Through a pipe, PHOTO or STROKES from standard input:
      cat photo.jpg | dior-rt relight - strokes.png -o - --format tif > relit.tif
    """
    watch = Watch()
    import numpy as np

    from dior_rt.files import check_readable
    from dior_rt.images.encoding import Encoding
    from dior_rt.images.photo import check_output, read_photo, write_photo
    from dior_rt.images.readers import default_form
    from dior_rt.images.sidecar import sidecar_path, write_sidecar
    from dior_rt.images.strokes import read_drawing
    from dior_rt.project import SUFFIX, hash_file, read_project

    check_readable(photo, "photo")
    encoding = Encoding(quality, int(bits) if bits else None)
    out = _with_format(out or photo.with_name(f"{photo.stem}-relit.{format or default_form(photo)}"), format)
    project = read_project(strokes) if strokes.suffix.lower() == SUFFIX else None
    if project:  # the project's settings apply unless the command line overrides them
        preset, steps = preset or project.settings.preset, steps or project.settings.steps
        seed, intensity = seed or project.settings.seed, intensity * project.settings.intensity
    _refuse_same(out, photo, strokes)
    check_free(out, overwrite)
    if sidecar:
        check_free(sidecar_path(out), overwrite)
    with _loading(bundle, device, ops) as load:
        picture = read_photo(photo).with_bits(encoding.bits)
        check_output(out, picture, encoding)
        drawing = read_drawing(strokes, picture.size, key, page, picture.primaries)
        watch.lap("read")
        relighter = load()
        watch.lap("load")
    with _progress("Relighting", quiet) as advance:
        relit = relighter.relight(
            picture.pixels,
            drawing.strokes,
            preset=preset,
            steps=steps,
            solver=solver,
            shift=shift,
            guidance=guidance,
            interval=interval,
            tolerance=tolerance,
            seed=seed,
            intensity=intensity,
            reach=reach,
            progress=watch.first_step(advance),
        )
    watch.lap("relight")
    settings = relighter.facts() | relit.facts()
    lost = write_photo(out, picture.with_pixels(np.asarray(relit.picture)), settings, encoding)
    if sidecar:
        write_sidecar(out, picture, settings)
    watch.lap("write")
    notices = [
        *(f"{photo}: {notice}" for notice in picture.notices),
        *(f"{strokes}: {notice}" for notice in drawing.notices),
        *filter(None, [relit.notice, relighter.ops_notice]),
        *lost,
    ]
    if project and project.photo.sha256 not in ("", hash_file(photo)):
        notices.append(f"{strokes} was drawn on another file than {photo}, of the same size.")
    if quiet:
        notices = []
    _report(out, picture.size, settings, watch.seconds | relit.seconds, relighter, notices, as_json)


def estimate(
    photo: options.Photo,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="LUMI", help="EXR, NPY or a picture [default: PHOTO-lumi.exr]."),
    ] = None,
    bundle: options.Bundle = None,
    device: options.Device = "auto",
    ops: options.Ops = "auto",
    steps: options.Steps = None,
    seed: options.Seed = 0,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Estimate the light that lies on PHOTO: its Lumi map.

    A Lumi map holds the light that would leave each surface if all were white and matte. EXR and NPY keep it
    linear and in full; a PNG shows it, clipped to display white. It has the size of the model's light grid.

    \b
      dior-rt estimate photo.jpg
      dior-rt estimate photo.jpg -o lumi.png
    """
    watch = Watch()
    from dior_rt.files import check_readable
    from dior_rt.images.photo import read_photo
    from dior_rt.images.strokes import check_lumi_output, write_lumi

    check_readable(photo, "photo")
    out = out or photo.with_name(f"{photo.stem}-lumi.exr")
    _refuse_same(out, photo)
    with _loading(bundle, device, ops) as load:
        picture = read_photo(photo)
        check_lumi_output(out)
        watch.lap("read")
        relighter = load()
        watch.lap("load")
    with _progress("Estimating") as advance:
        lumi = relighter.estimate(picture.pixels, steps=steps, seed=seed, progress=watch.first_step(advance))
    watch.lap("estimate")
    settings = relighter.facts() | {"steps": steps or relighter.bundle.manifest.steps, "seed": seed}
    write_lumi(out, lumi, settings, picture.primaries)
    watch.lap("write")
    _report(out, lumi.shape[:2], settings, watch.seconds, relighter, picture.notices, as_json)


def sparsify(
    lumi: Annotated[
        Path, typer.Argument(metavar="LUMI", help="A dense Lumi map: EXR or NPY, or a picture of one.")
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="STROKES", help="RGBA PNG, or NPY or EXR to keep all.")
    ],
    mode: Annotated[
        Literal["strokes", "coarse", "dense"], typer.Option(help="How much of the map is kept, and how.")
    ] = "strokes",
    seed: options.Seed = 0,
    debug: options.Debug = False,
) -> None:
    """Make of a dense Lumi map what a person might have drawn.

    \b
      dior-rt estimate photo.jpg -o lumi.exr
      dior-rt sparsify lumi.exr -o strokes.png --seed 7
      dior-rt relight photo.jpg strokes.png --intensity 2
    """
    from dior_rt.images.strokes import check_strokes_output, read_lumi, write_strokes
    from dior_rt.kernels import NumpyOps

    _refuse_same(out, lumi)
    check_strokes_output(out)
    strokes = NumpyOps().sparsify(read_lumi(lumi), mode, seed)
    write_strokes(out, strokes, {"version": __version__, "mode": mode, "seed": seed})
    if out.suffix.lower() == ".png" and (strokes.light[strokes.mask > 0] > 1).any():
        _warn("Light above display white was clipped; a .npy or .exr file keeps it.")


class Watch(Stopwatch):
    """Measures the seconds of each stage, and the seconds until the first step of the sampler."""

    def first_step(self, advance: Callable[[int, int], None]) -> Callable[[int, int], None]:
        """Call `advance`, and note the time of the first call."""

        def noted(step: int, steps: int) -> None:
            self.seconds.setdefault("first_step", perf_counter() - self.start)
            advance(step, steps)

        return noted


@contextmanager
def _loading(bundle: Path | None, device: str, ops: str) -> Iterator[Callable[[], Relighter]]:
    """Load the model while the block reads pictures. The function that the block gets waits for the model."""

    def load() -> Relighter:
        from dior_rt.relight import Relighter

        return Relighter(bundle, device, ops)

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(load).result


def _report(
    out: Path,
    size: tuple[int, ...],
    settings: dict[str, Any],
    seconds: dict[str, float],
    relighter: Relighter,
    notices: list[str] | tuple[str, ...],
    as_json: bool,
) -> None:
    if not as_json:
        for notice in notices:
            _warn(notice)
        return
    report = {
        "result": str(out),
        "size": [size[1], size[0]],
        "settings": settings,
        "seconds": {stage: round(value, 4) for stage, value in seconds.items()},
        "device": {"name": relighter.device, "reason": relighter.device_reason},
        "ops": {"name": relighter.ops, "reason": relighter.ops_reason},
        "notices": list(notices),
    }
    say(json.dumps(report, indent=2))


def _warn(notice: str) -> None:
    typer.echo(f"dior-rt: {notice}", err=True)


def _refuse_same(out: Path, *inputs: Path) -> None:
    """Raise InputError where the result would replace one of the files that it is made from."""
    for path in inputs:
        if is_same_file(out, path):
            raise InputError(f"{out} is read from; name another file for the result.")


def _with_format(out: Path, form: str | None) -> Path:
    """Return the result's name, with the suffix of --format where it has none. Raises InputError."""
    if form is None:
        return out
    if not out.suffix:
        return out.with_suffix(f".{form}")
    alike = {".jpeg": ".jpg", ".tiff": ".tif"}
    if alike.get(out.suffix.lower(), out.suffix.lower()) != f".{form}":
        raise InputError(f"{out} and --format {form} ask for two kinds of file; leave one of them out.")
    return out


@contextmanager
def _progress(label: str, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Yield a callback that moves a bar on a terminal, and does nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        yield lambda step, steps: None
        return
    with typer.progressbar(length=1000, label=label, file=sys.stderr) as bar:

        def advance(step: int, steps: int) -> None:
            bar.update(1000 * step // steps - bar.pos)

        yield advance
