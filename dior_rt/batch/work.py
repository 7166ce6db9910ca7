"""Relight one photo of a batch, from file to file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from dior_rt.batch.journal import Print
from dior_rt.batch.plan import Job
from dior_rt.errors import DiorError, InputError
from dior_rt.files import make_folder, reason
from dior_rt.images.encoding import PLAIN, Encoding
from dior_rt.images.photo import check_output, read_photo, write_photo
from dior_rt.images.sidecar import write_sidecar
from dior_rt.images.strokes import Key, read_drawing
from dior_rt.project import SUFFIX, read_project

if TYPE_CHECKING:
    from dior_rt.relight import Relighter


@dataclass(frozen=True)
class Recipe:
    """The options for all photos of a batch.

    options: those of `Relighter.relight`. key: as `read_drawing` takes it. sidecar: whether an XMP file is
    written beside each result.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    key: Key | None = None
    encoding: Encoding = PLAIN
    sidecar: bool = False


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    error: None where its result is written. The prints are those of the files as used.
    """

    job: Job
    error: str | None = None
    notices: tuple[str, ...] = ()
    photo: Print | None = None
    strokes: Print | None = None
    output: Print | None = None
    seconds: float = 0.0


def relight_file(
    relighter: Relighter,
    job: Job,
    recipe: Recipe,
    turn: AbstractContextManager[Any] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Relight the photo into its result, which is written whole or not at all, and return errors as outcomes.

    turn: a lock held while the network runs, not while files are read and written.
    stopped: called after every step; whether to stop.
    """
    start = perf_counter()
    try:
        photo, strokes = Print.of(job.photo), Print.of(job.strokes)
        picture = read_photo(job.photo).with_bits(recipe.encoding.bits)
        make_folder(job.result.parent)
        check_output(job.result, picture, recipe.encoding)
        drawing = read_drawing(job.strokes, picture.size, recipe.key, primaries=picture.primaries)
        with turn or nullcontext():
            relit = relighter.relight(
                picture.pixels,
                drawing.strokes,
                progress=lambda step, steps: not stopped(),
                **_options(job, recipe),
            )
        settings = relighter.facts() | relit.facts()
        if recipe.sidecar:
            write_sidecar(job.result, picture, settings)
        lost = write_photo(
            job.result, picture.with_pixels(np.asarray(relit.picture)), settings, recipe.encoding
        )
        notices = (
            *picture.notices,
            *(f"{job.strokes}: {notice}" for notice in drawing.notices),
            *([relit.notice] if relit.notice else []),
            *lost,
        )
        return Outcome(
            job, None, notices, photo, strokes, Print.of(job.result), round(perf_counter() - start, 3)
        )
    except DiorError as error:
        return Outcome(job, str(error))
    except MemoryError:
        return Outcome(job, "There is not enough memory for it; relight it alone, or make it smaller.")
    except OSError as error:
        return Outcome(job, str(InputError(f"Cannot read {job.photo} or {job.strokes}: {reason(error)}.")))
    except Exception as error:  # an error in one photo must not end the work on the others
        return Outcome(job, f"An unexpected error: {type(error).__name__}: {error}")


def _options(job: Job, recipe: Recipe) -> dict[str, Any]:
    """The options of `Relighter.relight`; a project's settings hold where the batch leaves them open."""
    options = dict(recipe.options)
    if job.strokes.suffix.lower() == SUFFIX:
        settings = read_project(job.strokes).settings
        for name in ("preset", "steps", "seed"):
            options[name] = options.get(name) or getattr(settings, name)
        options["intensity"] = options.get("intensity", 1.0) * settings.intensity
    return options
