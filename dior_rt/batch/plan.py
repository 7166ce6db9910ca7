"""Plan a batch: which photo goes with which strokes into which result, and what needs no work."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dior_rt.batch.find import Found
from dior_rt.batch.journal import Record
from dior_rt.batch.match import find_strokes
from dior_rt.errors import InputError
from dior_rt.files import check_readable
from dior_rt.images.readers import default_form


@dataclass(frozen=True)
class Job:
    """One photo to relight. name: of the result below the folder of results; it is the journal's key."""

    photo: Path
    strokes: Path
    result: Path
    name: str


@dataclass(frozen=True)
class Refused:
    """A photo that cannot be relit, and why."""

    photo: Path
    name: str
    reason: str


@dataclass(frozen=True)
class Plan:
    """jobs: what is to be done. done: photos whose results are there. refused: what cannot be."""

    jobs: tuple[Job, ...]
    done: tuple[Job, ...]
    refused: tuple[Refused, ...]


def make_plan(
    photos: Sequence[Found],
    strokes: Path | None,
    out: Path,
    form: str | None,
    records: Mapping[str, Record],
    settings: str,
    overwrite: bool,
) -> Plan:
    """Match the photos with their strokes and results, and compare them with the journal's records.

    form: the results' suffix; None: by each photo. settings: the hash of all that decides the results beside
    the files. A result that this program wrote and nobody changed since is replaced where its photo, strokes
    or settings have changed; any other file only with overwrite. Raises InputError where two photos would
    have the same result.
    """
    jobs: list[Job] = []
    done: list[Job] = []
    refused: list[Refused] = []
    for photo, name in zip(photos, _names(photos, form), strict=True):
        result = out / name
        try:
            drawing = find_strokes(photo.path, photo.place, strokes)
            check_readable(photo.path, "photo")
            check_readable(drawing, "strokes")
            job = Job(photo.path, drawing, result, name)
            if _needs_work(job, records.get(name), settings, overwrite):
                jobs.append(job)
            else:
                done.append(job)
        except InputError as error:
            refused.append(Refused(photo.path, name, str(error)))
    return Plan(tuple(jobs), tuple(done), tuple(refused))


def hash_settings(bundle: str, options: Mapping[str, Any]) -> str:
    """The hash of what decides results beside the files: the bundle's own hash, and the options."""
    text = json.dumps({"bundle": bundle, **options}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _needs_work(job: Job, record: Record | None, settings: str, overwrite: bool) -> bool:
    """Whether the result is to be made. Raises InputError where that would replace somebody's file."""
    there = job.result.exists()
    if record and record.output and record.photo and record.strokes:
        unaltered = record.output.fits(job.result)
        same = (
            record.settings == settings and record.photo.fits(job.photo) and record.strokes.fits(job.strokes)
        )
        if unaltered and same:
            return False
        if there and not unaltered and not overwrite:
            raise InputError(f"{job.result} was changed after it was made. Give --overwrite to replace it.")
        return True
    if record:  # begun and not done: what is there is what a killed process left
        return True
    if there and not overwrite:
        raise InputError(f"{job.result} is there already. Give --overwrite to replace it.")
    return True


def _names(photos: Sequence[Found], form: str | None) -> list[str]:
    """The results' names: a.png, or a.jpg.png and a.cr2.png for photos that differ by their suffix alone."""
    plain = [photo.place.with_suffix("").as_posix() for photo in photos]
    count = Counter(name.casefold() for name in plain)
    names = [
        (name if count[name.casefold()] == 1 else photo.place.as_posix())
        + f".{form or default_form(photo.path)}"
        for name, photo in zip(plain, photos, strict=True)
    ]
    taken: dict[str, Found] = {}
    for name, photo in zip(names, photos, strict=True):
        other = taken.setdefault(name.casefold(), photo)
        if other is not photo:
            raise InputError(
                f"{other.path} and {photo.path} would have the same result, {name}. "
                "Name the folder above both."
            )
    return names
