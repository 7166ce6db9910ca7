"""Run jobs in parallel worker threads, within bounds.

Each worker decodes, relights and encodes one photo. So one photo is decoded while another is relit and a
third encoded; Pillow, NumPy, zlib and ONNX Runtime let other threads run meanwhile. The number of workers and
the pixels in flight bound the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from threading import Event
from typing import Final

from PIL import Image

from dior_rt.batch.plan import Job
from dior_rt.batch.work import Outcome

#: Bytes of a file that count as one pixel where its header cannot be read. Camera raw has about as many.
BYTES_PER_PIXEL: Final = 1


def run_jobs(
    jobs: Iterable[Job],
    work: Callable[[Job], Outcome],
    workers: int,
    most_pixels: int,
    stop: Event,
    weigh: Callable[[Path], int] | None = None,
) -> Generator[Outcome, None, None]:
    """Yield the outcomes as they come. At most `workers` photos, of `most_pixels` together, are in flight.

    A photo larger than that is processed alone. When the caller stops early, or presses Ctrl-C, no further
    job begins, `stop` is set, and the jobs in flight end first. weigh: `count_pixels`, or a function like it.
    """
    weigh = weigh or count_pixels
    flying: dict[Future[Outcome], int] = {}
    pool = ThreadPoolExecutor(workers)
    try:
        for job in jobs:
            pixels = weigh(job.photo)
            while flying and (len(flying) >= workers or sum(flying.values()) + pixels > most_pixels):
                yield from _landed(flying)
            flying[pool.submit(work, job)] = pixels
        while flying:
            yield from _landed(flying)
    except BaseException:
        stop.set()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def count_pixels(photo: Path) -> int:
    """Return the pixels of a photo from its header, or an estimate from its file size without a readable
    header.
    """
    try:
        with Image.open(photo) as image:
            return image.width * image.height
    except Exception:  # reading the photo later reports what is wrong with it
        try:
            return photo.stat().st_size // BYTES_PER_PIXEL
        except OSError:
            return 0


def _landed(flying: dict[Future[Outcome], int]) -> list[Outcome]:
    """Wait for the next outcomes."""
    done, _ = wait(flying, return_when=FIRST_COMPLETED)
    for future in done:
        del flying[future]
    return [future.result() for future in done]
