"""The evaluated methods: a bundle with settings, or the pictures of another method in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dior_rt.bundle import MANIFEST
from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.reach import check_reach
from dior_rt.relight import Relighter
from dior_rt.sampling import SamplingOptions, resolve_sampling
from dior_rt.training.evaluation.layouts import read_picture
from dior_rt.training.evaluation.metrics import Photo, Raster
from dior_rt.training.evaluation.tasks import Task


@dataclass(frozen=True)
class Settings:
    """The settings of the runtime. None takes the bundle's; for `reach`, None means no limit.

    Raises InputError for an invalid reach.
    """

    steps: int | None = None
    guidance: float | None = None
    noise_scale: float | None = None
    reach: float | None = None

    def __post_init__(self) -> None:
        check_reach(self.reach)


class Model:
    """A bundle in the runtime, with one seed for all pictures. settings: as used."""

    def __init__(self, relighter: Relighter, settings: Settings = Settings()) -> None:
        manifest = relighter.bundle.manifest
        self.relighter, self.name, self.grid = relighter, manifest.name, manifest.grid
        self.options = SamplingOptions(
            steps=settings.steps, guidance=settings.guidance, noise_scale=settings.noise_scale
        )
        used = resolve_sampling(relighter.bundle, self.options)
        self.settings = Settings(used.steps, used.guidance, used.noise_scale, settings.reach)

    def relight(self, photo: Photo | Raster, strokes: Strokes) -> Photo:
        """Return the photo, 8-bit or float sRGB, under the strokes, in the same dtype."""
        return np.asarray(
            self.relighter.relight(photo, strokes, self.options, reach=self.settings.reach).picture
        )

    def estimate(self, photo: Photo | Raster) -> Raster:
        """Return the estimated source Lumi map on the light grid, (h, w, 3), linear."""
        return self.relighter.estimate(photo, self.options)


@dataclass(frozen=True)
class Pictures:
    """A folder of another method's pictures, each named after its task: {task}.png."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    def picture(self, task: Task) -> Photo:
        """Read a task's picture. Raises InputError if it is missing or of another size than the truth."""
        path = self.folder / f"{task.name}.png"
        picture = read_picture(path)
        if picture.shape != task.truth.shape:
            (h, w), (height, width) = picture.shape[:2], task.truth.shape[:2]
            raise InputError(f"{path} has {w} x {h} pixels and should have {width} x {height}.")
        return picture


def open_method(folder: Path, settings: Settings) -> Model | Pictures:
    """Open a bundle with settings, or a folder of pictures. Raises BundleError if the folder is neither."""
    if not (folder / MANIFEST).exists() and any(folder.glob("*.png")):
        return Pictures(folder)
    return Model(Relighter(folder), settings)
