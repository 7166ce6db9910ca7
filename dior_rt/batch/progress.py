"""Show the progress of a batch: a line on a terminal, failures as they come, and a last sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from time import monotonic

from dior_rt.batch.work import Outcome

Clock = Callable[[], float]


class Progress:
    """Counts outcomes and prints to standard error.

    quiet: print only failures. total: the number of photos to relight. done: results that existed before.
    """

    def __init__(self, total: int, done: int, quiet: bool = False, clock: Clock = monotonic) -> None:
        self.total, self.done, self.relit = total, done, 0
        self.failures: list[tuple[str, str]] = []
        self._quiet, self._clock, self._start = quiet, clock, clock()
        self._shows = not quiet and sys.stderr.isatty()
        self._shown = 0

    def note(self, outcome: Outcome) -> None:
        """Count an outcome."""
        if outcome.error is None:
            self.relit += 1
            for notice in () if self._quiet else outcome.notices:
                self._say(f"{outcome.job.photo}: {notice}")
        else:
            self.fail(str(outcome.job.photo), outcome.error)
        self._show(self.line())

    def fail(self, photo: str, why: str) -> None:
        """Count a photo that has no result, and print the reason."""
        self.failures.append((photo, why))
        self._say(f"{photo}: {why}")

    @property
    def seconds(self) -> float:
        """Return the seconds since the beginning."""
        return self._clock() - self._start

    def line(self) -> str:
        """Return the line of progress: photos done, speed, and time left."""
        ended = self.relit + len(self.failures)
        rate = ended / max(self.seconds, 1e-9)
        left = (self.total - ended) / rate if rate else 0
        return f"{ended} of {self.total}, {_rate(rate)}, {duration(max(left, 0))} left"

    def finish(self) -> None:
        """Print a summary of the batch."""
        self._show("")
        if self._quiet:
            return
        rate = f", {_rate(self.relit / max(self.seconds, 1e-9))}" if self.relit else ""
        before = f"{self.done} done before, " if self.done else ""
        failed = len(self.failures)
        self._say(f"{self.relit} relit, {before}{failed} failed, in {duration(self.seconds)}{rate}.")

    def _say(self, text: str) -> None:
        self._show("")
        print(f"dior-rt: {text}", file=sys.stderr)

    def _show(self, line: str) -> None:
        if self._shows:
            sys.stderr.write(f"\r{line:<{self._shown}}" + ("" if line else "\r"))
            sys.stderr.flush()
            self._shown = len(line)


def duration(seconds: float) -> str:
    """Return a time in everyday units: 8 s, 3 min, 2 h 5 min."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def _rate(photos_a_second: float) -> str:
    if photos_a_second >= 1:
        return f"{photos_a_second:.1f} photos a second"
    return f"{photos_a_second * 60:.1f} photos a minute"
