"""The judges by name, over a model and its baselines, as tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from dior_rt.errors import InputError
from dior_rt.training.evaluation.judges.added import added
from dior_rt.training.evaluation.judges.far import far
from dior_rt.training.evaluation.judges.form import form
from dior_rt.training.evaluation.judges.identity import identity
from dior_rt.training.evaluation.judges.material import material
from dior_rt.training.evaluation.judges.models import BundleModel, Judged, baselines
from dior_rt.training.evaluation.judges.objects import objects
from dior_rt.training.evaluation.judges.ratio import ratio
from dior_rt.training.evaluation.judges.slope import slope
from dior_rt.training.evaluation.judges.subjects import Subject, folder_photos, marked_photos
from dior_rt.training.evaluation.methods import Pictures, Settings, open_method
from dior_rt.training.evaluation.results import Evaluation, Table

PHOTOS: Final = "photos"  # in place of a folder: the marked photos
OnPhotos = Callable[[Sequence[Judged], Sequence[Subject]], Table]
ON_PHOTOS: Final[dict[str, OnPhotos]] = {"identity": identity, "slope": slope, "far": far}
ON_MARKS: Final[dict[str, OnPhotos]] = {"objects": objects, "form": form}
JUDGES: Final = ("material", *ON_MARKS, *ON_PHOTOS, "added", "ratio")


def parse_judges(text: str) -> tuple[str, ...]:
    """Return the judges in a comma-separated list. Raises InputError for an unknown one."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if unknown := [name for name in names if name not in JUDGES]:
        raise InputError(f"There is no judge {unknown[0]}. Choose from {', '.join(JUDGES)}.")
    if not names:
        raise InputError(f"No judge is named. Choose from {', '.join(JUDGES)}.")
    return names


def judge(folder: Path, subject: Path, names: Sequence[str], settings: Settings, views: int) -> Evaluation:
    """Judge a bundle and the baselines. subject: the word `photos`, or a folder of photos, renders or pairs.

    Raises InputError where a judge cannot work on the subject, and what reading raises.
    """
    on_marks = str(subject) == PHOTOS
    for name in names:
        if on_marks and name in ("added", "ratio"):
            kind = "renders" if name == "added" else "pairs of photos"
            raise InputError(f"The judge {name} needs a folder of {kind} in place of the word {PHOTOS}.")
        if not on_marks and name in ON_MARKS:
            raise InputError(f"The judge {name} needs marks. Write the word {PHOTOS} in place of {subject}.")
    photos: list[Subject] = []
    if set(names) & {"material", *ON_PHOTOS, *ON_MARKS}:
        photos = marked_photos() if on_marks else folder_photos(subject)
    method = open_method(folder, settings)
    if isinstance(method, Pictures):
        raise InputError(f"{folder} holds pictures. Judges draw on photos, so they need a bundle.")
    model = BundleModel(method)
    models = (model, *baselines(model))
    tables: list[Table] = []
    for name in names:
        if name == "material":
            tables.append(material(models, photos, str(subject.name)))
        elif name == "added":
            tables.append(added(models, subject, views))
        elif name == "ratio":
            tables += ratio(models, subject, views)
        else:
            tables.append({**ON_PHOTOS, **ON_MARKS}[name](models, photos))
    return Evaluation(method.name, method.settings, tuple(tables))
