"""The progress of a training run, planned by time or by steps. The learning rate follows it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

WARM_UP: Final = 0.04  # share of a run
DECAY: Final = 0.35
AVERAGED: Final = 0.06  # time constant of the weights' average, as a share of the run
SETTLING: Final = 3  # steps that compile; their time counts as setup


@dataclass
class Clock:
    """The progress of a run, 0..1. A resumed run goes on where it stopped.

    steps: of the whole run, where minutes is None.
    minutes: of the whole run, with loading and compiling; None: `steps` decide.
    step: steps taken, in all processes.
    spent: seconds of training at full speed, in all processes.
    """

    steps: int
    minutes: float | None
    step: int = 0
    spent: float = 0.0
    _first: int | None = None
    _setup: float = 0.0
    _last: float = field(default_factory=time.monotonic)

    @property
    def done(self) -> float:
        """Return the share of the run that is done."""
        if self.minutes is not None:
            return self.spent / max(60 * self.minutes - self._setup, 1.0)
        return self.step / self.steps

    @property
    def rate(self) -> float:
        """Return the learning rate as a share of the largest: warm up, stay, fall to 0."""
        warm = min(1.0, (self.step + 1) / 100, self.done / WARM_UP + 0.01)
        return warm * min(1.0, max(0.0, (1 - self.done) / DECAY))

    @property
    def taken(self) -> int:
        """Return the steps taken in this process."""
        return self.step - (self.step if self._first is None else self._first)

    @property
    def average_share(self) -> float:
        """Return the factor by which the weights' average moves towards the weights in this step."""
        total: float = self.steps
        if self.minutes is not None:
            total = max((self.taken + 1) / max(self.done, 1e-3), 50.0)
        return max(1 / (self.step + 2), min(0.05, 1 / (AVERAGED * total)))

    def tick(self) -> None:
        """Count one step and its time."""
        if self._first is None:
            self._first = self.step
        self.step += 1
        now = time.monotonic()
        if self.taken > SETTLING:
            self.spent += now - self._last
        else:
            self._setup = seconds_since_start()
        self._last = now


def seconds_since_start() -> float:
    """Return how long this process has run, or 0 where the system does not report it."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
        return max(0.0, uptime - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return 0.0
