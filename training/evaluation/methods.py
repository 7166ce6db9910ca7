"""What is evaluated: a bundle under some settings, or the pictures that another method left in a folder."""

from __future__ import annotations

from copy import copy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from dior_rt.bundle import MANIFEST
from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.reach import check_reach
from dior_rt.relight import Relighter
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.metrics import Photo, Raster
from dior_rt.training.evaluation.tasks import Task


@dataclass(frozen=True)
class Settings:
    """What is asked of the runtime; None takes the bundle's own, and of `reach` that the model decides.

    Raises InputError for a reach that cannot be.
    """

    steps: int | None = None
    guidance: float | None = None
    noise_scale: float | None = None
    reach: float | None = None

    def __post_init__(self) -> None:
        check_reach(self.reach)


class Model:
    """A bundle by the runtime as people run it, one seed for all pictures. settings: as used."""

    def __init__(self, relighter: Relighter, settings: Settings = Settings()) -> None:
        given = {name: value for name, value in asdict(settings).items() if value is not None}
        given.pop("reach", None)  # a bundle has none of its own
        manifest = replace(relighter.bundle.manifest, **given)
        self.relighter = copy(relighter)
        self.relighter.bundle = replace(relighter.bundle, manifest=manifest)
        self.name, self.grid = manifest.name, manifest.grid
        self.settings = Settings(manifest.steps, manifest.guidance, manifest.noise_scale, settings.reach)

    def relight(self, photo: Photo | Raster, strokes: Strokes) -> Photo:
        """The photo, 8-bit or float sRGB, under the strokes; what comes back is of its dtype."""
        return np.asarray(self.relighter.relight(photo, strokes, reach=self.settings.reach).picture)

    def estimate(self, photo: Photo | Raster) -> Raster:
        """The photo's own light on the light grid, (h, w, 3) linear."""
        return self.relighter.estimate(photo)


@dataclass(frozen=True)
class Pictures:
    """A folder of another method's pictures, each named after its task: {task}.png."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    def picture(self, task: Task) -> Photo:
        """Raises InputError where it is missing or of another size than the truth."""
        path = self.folder / f"{task.name}.png"
        picture = read_picture(path)
        if picture.shape != task.truth.shape:
            (h, w), (height, width) = picture.shape[:2], task.truth.shape[:2]
            raise InputError(f"{path} has {w} x {h} pixels and should have {width} x {height}.")
        return picture


def open_method(folder: Path, settings: Settings) -> Model | Pictures:
    """A bundle under these settings, or a folder of pictures. Raises BundleError for one that is neither."""
    if not (folder / MANIFEST).exists() and any(folder.glob("*.png")):
        return Pictures(folder)
    return Model(Relighter(folder), settings)
