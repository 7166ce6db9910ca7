"""Where the time of a run goes."""

from __future__ import annotations

from time import perf_counter


class Stopwatch:
    """Seconds by stage. start: when it was made, on the clock of `perf_counter`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start = self._last = perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap on `stage`."""
        now = perf_counter()
        self.seconds[stage], self._last = now - self._last, now
