"""Measure where the time of a run goes."""

from __future__ import annotations

from time import perf_counter


class Stopwatch:
    """Seconds by stage. start: the time of creation, on the clock of `perf_counter`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start = self._last = perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to `stage`."""
        now = perf_counter()
        self.seconds[stage], self._last = now - self._last, now
