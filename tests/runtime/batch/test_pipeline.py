"""The pipeline: bounds, order of events, stopping."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.batch.pipeline import count_pixels, run_jobs
from dior_rt.batch.plan import Job
from dior_rt.batch.work import Outcome


def jobs(count: int) -> list[Job]:
    return [Job(Path(f"{i}"), Path("s"), Path("r"), f"{i}") for i in range(count)]


class Load:
    """A job that records how many photos are in flight at once."""

    def __init__(self, sizes: dict[str, int] | None = None) -> None:
        self.sizes, self.flying, self.most, self.most_pixels = sizes or {}, set(), 0, 0
        self.lock = threading.Lock()

    def weigh(self, photo: Path) -> int:
        return self.sizes.get(str(photo), 1)

    def __call__(self, job: Job) -> Outcome:
        with self.lock:
            self.flying.add(str(job.photo))
            self.most = max(self.most, len(self.flying))
            self.most_pixels = max(self.most_pixels, sum(self.sizes.get(name, 1) for name in self.flying))
        time.sleep(0.01)
        with self.lock:
            self.flying.remove(str(job.photo))
        return Outcome(job)


def test_every_job_is_carried_through_once_and_side_by_side() -> None:
    load = Load()
    outcomes = list(run_jobs(jobs(20), load, 3, 10**9, threading.Event(), load.weigh))
    assert sorted(int(o.job.name) for o in outcomes) == list(range(20))
    assert load.most == 3


def test_pixels_in_flight_are_bounded_and_a_giant_goes_alone() -> None:
    load = Load({"2": 50, "5": 200})
    list(run_jobs(jobs(9), load, 4, 51, threading.Event(), load.weigh))
    assert load.most_pixels == 200  # the giant, alone: together with any other it would be 201


def test_jobs_are_taken_as_they_are_needed() -> None:
    taken = []

    def endless():
        for i in range(10**9):
            taken.append(i)
            yield Job(Path(str(i)), Path(), Path(), str(i))

    stop = threading.Event()
    outcomes = run_jobs(endless(), Outcome, 2, 10**9, stop, lambda photo: 1)
    for _ in range(5):
        next(outcomes)
    outcomes.close()
    assert len(taken) < 20 and stop.is_set()


def test_an_interruption_stops_those_in_flight() -> None:
    stop = threading.Event()

    def work(job: Job) -> Outcome:
        if job.name == "0":
            raise KeyboardInterrupt
        return Outcome(job, None if stop.wait(10) else "it was not stopped")

    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(jobs(50), work, 2, 10**9, stop, lambda photo: 1))
    assert stop.is_set()


def test_pixels_are_counted_by_the_header(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((30, 20, 3), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "raw").write_bytes(bytes(1234))
    assert count_pixels(tmp_path / "a.png") == 600
    assert count_pixels(tmp_path / "raw") == 1234
    assert count_pixels(tmp_path / "none") == 0
