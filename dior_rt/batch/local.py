"""Relight a batch on this machine, in threads of this process."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from threading import BoundedSemaphore, Event
from typing import Final

from dior_rt.batch.pipeline import run_jobs
from dior_rt.batch.plan import Job
from dior_rt.batch.work import Outcome, Recipe, relight_file
from dior_rt.bench.plan import usable_cores
from dior_rt.bundle import Bundle
from dior_rt.relight import Relighter

#: A model with fewer bytes relights one photo on each core. A larger model uses all cores for one photo.
SMALL_MODEL: Final = 1 << 30


@dataclass(frozen=True)
class LocalEngine:
    """Relights on this machine, in threads of this process."""

    bundle: Bundle
    device: str
    ops: str
    at_once: int | None
    most_pixels: int

    def run(
        self, jobs: Iterable[Job], recipe: Recipe, begin: Callable[[str], None]
    ) -> Generator[Outcome, None, None]:
        """Yield the outcomes as they come.

        `begin` is called with each result's name before it may be written.
        """
        weights = sum((self.bundle.folder / file).stat().st_size for file in self.bundle.manifest.files)
        at_once = self.at_once or (usable_cores() if weights < SMALL_MODEL else 1)
        # One thread per photo wastes no time on waiting for other threads. A single photo gets all of them.
        threads = max(1, usable_cores() // at_once) if at_once > 1 else None
        relighter = Relighter(self.bundle.folder, self.device, self.ops, threads)
        if relighter.device != "cpu" and not self.at_once:
            at_once = 1
        turns, stop = BoundedSemaphore(at_once), Event()

        def work(job: Job) -> Outcome:
            begin(job.name)
            return relight_file(relighter, job, recipe, turns, stop.is_set)

        # One photo more than are relit, so that files are read and written meanwhile.
        return run_jobs(jobs, work, at_once + 1, self.most_pixels, stop)
