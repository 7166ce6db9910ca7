"""The server's work, without HTTP: photos that stay open, previews, full results, exports."""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.desk.jobs import Job, Queue
from dior_rt.drawing import Painter
from dior_rt.errors import Cancelled, InputError
from dior_rt.images.arrays import to_8_bits
from dior_rt.images.photo import Photo, read_photo, write_photo
from dior_rt.kernels import Strokes
from dior_rt.lights import Light
from dior_rt.project import Project, hash_file, lights_of
from dior_rt.relight import OpenPhoto, Relighter

MOST_PHOTOS: Final = 3  # photos that stay open; the least recently used one is closed
QUALITY: Final = 92  # the quality of JPEG previews
MOST_PREVIEW: Final = 2048  # pixels of a preview's longer side


@dataclass(frozen=True)
class Shown:
    """A photo on the desk. id: a hash of its file's bytes."""

    id: str
    name: str
    file: Photo
    open: OpenPhoto
    painter: Painter
    previewing: threading.Lock

    def lights(self, project: Project) -> list[Light]:
        """Return the project's lights, drawn for this photo."""
        return lights_of(project, self.file.size, self.painter)


@dataclass(frozen=True)
class Result:
    """A full result. settings: those that made it, for its metadata."""

    photo: Photo
    settings: dict[str, Any]
    notice: str | None


class Newest:
    """The latest request number of each page, which shows whether a newer request has come."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def note(self, page: str, number: int) -> Callable[[], bool]:
        """Record a request. Returns a function that reports whether it is still the latest of its page."""
        self._last[page] = max(number, self._last.get(page, number))
        while len(self._last) > 64:
            del self._last[next(iter(self._last))]
        return lambda: self._last.get(page, number) == number


class Studio:
    """The model, which loads while the page opens; the photos; and the queue of full results."""

    def __init__(self, load: Callable[[], Relighter], folder: Path) -> None:
        """Start to load the model.

        load: makes it. folder: for files that are deleted when the desk closes.
        """
        self.folder = folder
        self.queue = Queue()
        self.newest = Newest()
        self._pool = ThreadPoolExecutor(1, "load")
        self._loading: Future[Relighter] = self._pool.submit(load)
        self._photos: OrderedDict[str, Shown] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def relighter(self) -> Relighter:
        """Return the model once it is loaded. Raises the error of its loading."""
        return self._loading.result()

    @property
    def ready(self) -> bool:
        return self._loading.done()

    def close(self) -> None:
        """Stop all work."""
        self.queue.close()
        self._pool.shutdown(wait=True)

    def open(self, path: Path, name: str) -> Shown:
        """Put the photo of a file on the desk. Raises InputError."""
        digest = hash_file(path)
        if shown := self.photo(digest):
            return replace(shown, name=name)
        try:
            photo = read_photo(path)
        except InputError as error:
            raise InputError(str(error).replace(f" {path}", f" {name}")) from error
        shown = Shown(
            digest,
            name,
            photo,
            self.relighter.open(photo.pixels, photo.primaries),
            Painter(photo.size, kept=64),
            threading.Lock(),
        )
        with self._lock:
            self._photos[digest] = shown
            self._photos.move_to_end(digest)
            while len(self._photos) > MOST_PHOTOS:
                self._photos.popitem(last=False)
        return shown

    def photo(self, name: str) -> Shown | None:
        """Return a photo by its id, or None where it is not, or no longer, on the desk."""
        with self._lock:
            if name in self._photos:
                self._photos.move_to_end(name)
            return self._photos.get(name)

    def preview(
        self, shown: Shown, project: Project, longest: int, is_newest: Callable[[], bool]
    ) -> tuple[bytes, str | None]:
        """Return a small JPEG of the photo under the lights, and a notice for the user.

        Raises Cancelled as soon as a newer preview is requested.
        """
        with shown.previewing:
            if not is_newest():
                raise Cancelled("A newer preview was asked for.")
            relit = shown.open.preview(
                shown.lights(project),
                longest=min(longest, MOST_PREVIEW),
                seed=project.settings.seed,
                intensity=project.settings.intensity,
                progress=lambda step, steps: is_newest(),
            )
        return encode_jpeg(np.asarray(relit.picture), shown.file), relit.notice

    def target(self, shown: Shown, project: Project) -> Strokes:
        """Return the light that the lights ask for, on the light grid."""
        return shown.open.target_map(shown.lights(project), intensity=project.settings.intensity)

    def relight(self, shown: Shown, project: Project) -> Job | None:
        """Queue a full result and return its job, or None where the queue is full."""

        def work(job: Job) -> Result:
            settings = project.settings
            relit = shown.open.relight(
                shown.lights(project),
                preset=settings.preset,
                steps=settings.steps,
                seed=settings.seed,
                intensity=settings.intensity,
                progress=job.progress,
            )
            facts = self.relighter.facts() | relit.facts()
            return Result(shown.file.with_pixels(np.asarray(relit.picture)), facts, relit.notice)

        return self.queue.submit(work)

    def export(self, result: Result, suffix: str) -> bytes:
        """Return the file that `dior-rt relight` would write. suffix: such as ".png". Raises InputError."""
        path = self.folder / f"{threading.get_ident()}{suffix}"
        try:
            write_photo(path, result.photo, result.settings)
            return path.read_bytes()
        finally:
            path.unlink(missing_ok=True)


def encode_jpeg(pixels: NDArray, photo: Photo) -> bytes:
    """Return a picture for the page as a JPEG, with the profile of the photo that it shows."""
    # A profile whose curve differs from sRGB's would not fit these pixels.
    profile = {} if photo.curves else {"icc_profile": photo.icc}
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=QUALITY, subsampling=0, **profile)
    return file.getvalue()


def shrink(photo: Photo, longest: int) -> NDArray[np.uint8]:
    """Return a photo's pixels for the page: uint8, at most `longest` per side."""
    image = Image.fromarray(to_8_bits(photo.pixels))
    image.thumbnail((longest, longest), Image.Resampling.BOX, reducing_gap=2.0)
    return np.asarray(image)
