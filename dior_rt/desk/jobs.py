"""Run long work: one job at a time, in order, with progress that others can follow, and with cancellation."""

from __future__ import annotations

import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from dior_rt.errors import Cancelled, DiorError

Stage = Literal["queued", "running", "done", "failed", "cancelled"]
FINAL: Final = ("done", "failed", "cancelled")


@dataclass(frozen=True)
class State:
    """The state of a job.

    ahead: jobs before it; step, steps: those of the sampler; message: what went wrong.
    """

    stage: Stage
    ahead: int = 0
    step: int = 0
    steps: int = 0
    message: str = ""


class Job:
    """One piece of work, its state, and finally its result."""

    def __init__(self, work: Callable[[Job], Any]) -> None:
        self.id = secrets.token_urlsafe(9)
        self.result: Any = None
        self._work = work
        self._state = State("queued")
        self._changed = threading.Condition()
        self._cancelled = False

    @property
    def state(self) -> State:
        """Return the present state."""
        return self._state

    def progress(self, step: int, steps: int) -> bool:
        """Record a step. Returns False to stop the work. The caller passes this to `Relighter.relight`."""
        self.move(replace(self._state, step=step, steps=steps))
        return not self._cancelled

    def cancel(self) -> None:
        """Ask the job to stop, now or before it starts."""
        self._cancelled = True

    def states(self, patience: float = 15.0) -> Iterator[State | None]:
        """Yield the states as they change, from the present one to a final one.

        Yields None after `patience` seconds without a change.
        """
        seen: State | None = None
        while seen is None or seen.stage not in FINAL:
            with self._changed:
                if self._state == seen:
                    self._changed.wait(patience)
                news = self._state if self._state != seen else None
            yield news
            seen = news or seen

    def move(self, state: State) -> None:
        """Change the state, and wake the threads that follow it."""
        with self._changed:
            self._state = state
            self._changed.notify_all()

    def run(self) -> None:
        """Run the work. Its errors become the state."""
        if self._cancelled:
            return self.move(State("cancelled"))
        self.move(State("running"))
        try:
            self.result = self._work(self)
        except Cancelled:
            self.move(State("cancelled"))
        except (DiorError, MemoryError) as error:
            self.move(State("failed", message=str(error) or "There is not enough memory for this."))
        except Exception:
            logging.getLogger("dior_rt").exception("A job of the desk failed.")
            self.move(State("failed", message="Something unexpected went wrong; see the terminal."))
        else:
            self.move(replace(self._state, stage="done"))


class Queue:
    """Jobs in the order of arrival, one of which runs at a time. The last results are kept."""

    def __init__(self, kept: int = 4, waiting: int = 8) -> None:
        """Start the queue.

        kept: the number of finished jobs with results; waiting: the number of jobs that may wait.
        """
        self._kept, self._most_waiting = kept, waiting
        self._jobs: OrderedDict[str, Job] = OrderedDict()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(1, "relight")

    def submit(self, work: Callable[[Job], Any]) -> Job | None:
        """Add a job at the end of the queue and return it, or None where too many wait."""
        with self._lock:
            if len(self._open()) > self._most_waiting:
                return None
            job = Job(work)
            job.move(State("queued", ahead=len(self._open())))
            self._jobs[job.id] = job
            over = [one for one in self._jobs.values() if one.state.stage in FINAL]
            for old in over[: max(0, len(over) - self._kept)]:
                del self._jobs[old.id]
        self._pool.submit(self._run, job)
        return job

    def get(self, name: str) -> Job | None:
        """Return a job by its id, or None."""
        return self._jobs.get(name)

    def close(self) -> None:
        """Cancel the waiting and running jobs, and wait for the running one."""
        for job in self._open():
            job.cancel()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run(self, job: Job) -> None:
        job.run()
        with self._lock:
            for ahead, waiting in enumerate(self._open()):
                if waiting.state.stage == "queued":
                    waiting.move(replace(waiting.state, ahead=ahead))

    def _open(self) -> list[Job]:
        return [job for job in self._jobs.values() if job.state.stage not in FINAL]
