"""Relight a batch on a cluster, by Ray Data (extra [ray]).

Each actor holds one model and takes one photo at a time, from file to file; the folders must be the same on
all machines. Ray starts actors, chooses their number, and repeats what a lost worker left undone. The driver
keeps the journal. When the driver is restarted, photos that the journal lists as done are not assigned again.
"""

from __future__ import annotations

import logging
import os
import pickle
import socket
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # by default, Ray reports usage to its developers
os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "error")

import ray
import ray.data

from dior_rt.batch.plan import Job
from dior_rt.batch.work import Outcome, Recipe, relight_file
from dior_rt.bench.plan import usable_cores
from dior_rt.errors import DeviceError
from dior_rt.files import reason

#: Tasks in a batch. Each takes an equal share of the photos, which is one unless there are more photos than
#: tasks.
MOST_TASKS: Final = 10_000


class Worker:
    """One model on one machine. Ray calls it with rows that hold a pickled Job, and gets pickled Outcomes."""

    def __init__(self, bundle: Path, device: str, ops: str, recipe: Recipe) -> None:
        from dior_rt.relight import Relighter

        self._relighter, self._recipe = Relighter(bundle, device, ops, threads=1), recipe

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        return {
            "outcome": pickle.dumps(relight_file(self._relighter, pickle.loads(row["job"]), self._recipe))
        }


@dataclass(frozen=True)
class RayEngine:
    """Relights on a Ray cluster.

    address: that of the cluster, or None to start one on this machine. workers: the maximum number of actors,
    or None for one on each core.
    """

    bundle: Path
    device: str
    ops: str
    address: str | None = None
    workers: int | None = None

    def run(
        self, jobs: Iterable[Job], recipe: Recipe, begin: Callable[[str], None]
    ) -> Generator[Outcome, None, None]:
        """Yield the outcomes as they come. `begin` is called with the results' names before any is written.

        Raises DeviceError where the cluster cannot be reached, or gives up.
        """
        jobs = [
            Job(job.photo.resolve(), job.strokes.resolve(), job.result.resolve(), job.name) for job in jobs
        ]
        for job in jobs:
            begin(job.name)
        try:
            _check_reachable(self.address)
            logging.getLogger("ray").setLevel(logging.ERROR)
            alone: dict[str, Any] = {} if self.address else {"include_dashboard": False}
            # Ray gives an actor's BLAS one thread. Sums with other numbers of threads round differently, so
            # actors get as many threads as the local engine has.
            threads = os.environ.get("OMP_NUM_THREADS") or str(usable_cores())
            environment = {"env_vars": {"OMP_NUM_THREADS": threads}}
            ray.init(
                self.address,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env=environment,
                **alone,
            )
        except Exception as error:  # Ray raises a bare Exception where its own processes do not start
            raise DeviceError(f"Cannot use Ray's cluster {self.address or ''}: {reason(error)}.") from error
        try:
            yield from self._outcomes(jobs, recipe)
        except ray.exceptions.RayError as error:
            raise DeviceError(f"Ray gave up: {reason(error)}.") from error
        finally:
            ray.shutdown()

    def _outcomes(self, jobs: list[Job], recipe: Recipe) -> Iterator[Outcome]:
        context = ray.data.DataContext.get_current()
        context.enable_progress_bars = False
        context.print_on_execution_start = False
        rows = [{"job": pickle.dumps(job)} for job in jobs]
        most = self.workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        done = ray.data.from_items(rows, override_num_blocks=min(len(rows), MOST_TASKS)).map(
            Worker,  # type: ignore[arg-type]
            fn_constructor_args=(self.bundle.resolve(), self.device, self.ops, recipe),
            compute=ray.data.ActorPoolStrategy(min_size=1, max_size=min(most, len(rows))),
            num_cpus=1,
        )
        for row in done.iter_rows():
            yield pickle.loads(row["outcome"])


def _check_reachable(address: str | None) -> None:
    """Raise OSError at once where nothing listens at host:port. Ray itself would wait for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
