"""Plan a batch: assign strokes and a result to each photo, and find the photos that need no work."""

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
    """One photo to relight.

    name: the result's path below the folder of results, which is the journal's key.
    """

    photo: Path
    strokes: Path
    result: Path
    name: str


@dataclass(frozen=True)
class Refused:
    """A photo that cannot be relit, and the reason."""

    photo: Path
    name: str
    reason: str


@dataclass(frozen=True)
class Plan:
    """The plan of a batch.

    jobs: the work to do. done: photos whose results exist. refused: photos that cannot be relit.
    """

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

    form: the results' suffix, or None to choose it by each photo. settings: the hash of everything besides
    the files that decides the results. A result that this program wrote and that nobody has changed since is
    replaced where its photo, strokes or settings have changed. Any other file is replaced only with
    overwrite. Raises InputError where two photos would have the same result.
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
    """Return the hash of what decides results besides the files: the bundle's hash, and the options."""
    text = json.dumps({"bundle": bundle, **options}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _needs_work(job: Job, record: Record | None, settings: str, overwrite: bool) -> bool:
    """Return whether the result must be made. Raises InputError where that would replace a user's file."""
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
    if record:  # begun and not done: a killed process left this file
        return True
    if there and not overwrite:
        raise InputError(f"{job.result} is there already. Give --overwrite to replace it.")
    return True


def _names(photos: Sequence[Found], form: str | None) -> list[str]:
    """Return the results' names: a.png, or a.jpg.png and a.cr2.png for photos that differ only by their
    suffix.
    """
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
