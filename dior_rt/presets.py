"""The presets of a bundle: faster ways to sample, each with a promised error.

`reference` is the model's default: all of its steps, by Euler's method, with guidance at every sigma. The
other presets are data of the bundle, in presets.json. `python -m tools.presets` measures them with the
bundle's model.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dior_rt.bundle import MOST_STEPS, Bundle
from dior_rt.errors import BundleError
from dior_rt.files import reason
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.flow.solvers import SOLVERS
from dior_rt.records import parse, read_json

REFERENCE: Final = "reference"
#: The presets of a bundle and their promises: PSNR in dB against the reference's picture.
PROMISES: Final = {"balanced": 45.0, "fast": 40.0}
PRESETS: Final = "presets.json"
MOST_BYTES: Final = 1 << 16

ALWAYS: Final = (0.0, 1.0)


@dataclass(frozen=True)
class Preset:
    """How to sample the flow, measured with one model. Raises ValueError."""

    #: Number of solver steps.
    steps: int
    #: Name of the solver.
    solver: str = "euler"
    #: Shift of the schedule of sigmas; None keeps the model's schedule.
    shift: float | None = None
    #: The sigmas (low, high), both ends included, at which guidance acts.
    interval: tuple[float, float] = ALWAYS

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MOST_STEPS:
            raise ValueError(f"steps must lie between 1 and {MOST_STEPS}, not {self.steps}")
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(SOLVERS)}, not {self.solver!r}")
        if self.shift is not None:
            ShiftSchedule(self.shift)
        if not (len(self.interval) == 2 and 0 <= self.interval[0] <= self.interval[1] <= 1):
            raise ValueError(f"interval must be two numbers, 0 <= low <= high <= 1, not {self.interval}")


def read_presets(bundle: Bundle) -> dict[str, Preset]:
    """Return the bundle's presets by name, or none where it has no presets.json. Raises BundleError."""
    if PRESETS not in bundle.manifest.files:
        return {}
    try:
        return parse(dict[str, Preset], read_json(bundle.folder / PRESETS, MOST_BYTES))
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot read {Path(bundle.folder, PRESETS)}: {reason(error)}.") from error
