"""How the flow is walked, and the presets: ways to walk it faster whose name promises an error.

`reference` is the model's own: all of its steps, by Euler's method, with guidance at every sigma. The others
are data of the bundle, in presets.json: they were measured with its model, by `tools.presets`.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from dior_rt.bundle import MOST_STEPS, Bundle
from dior_rt.errors import BundleError, InputError
from dior_rt.files import reason
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.flow.solvers import SOLVERS
from dior_rt.records import parse, read_json

REFERENCE: Final = "reference"
#: The presets of a bundle, and what they promise: PSNR in dB to the reference's picture.
PROMISES: Final = {"balanced": 45.0, "fast": 40.0}
PRESETS: Final = "presets.json"
MOST_BYTES: Final = 1 << 16

ALWAYS: Final = (0.0, 1.0)


@dataclass(frozen=True)
class Preset:
    """steps: of the solver. solver: its name. shift: of the schedule of sigmas; None is the model's own.
    interval: of the sigmas, both ends included, at which guidance acts. Raises ValueError."""

    steps: int
    solver: str = "euler"
    shift: float | None = None
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


@dataclass(frozen=True)
class Sampling(Preset):
    """A preset together with what it leaves to the model or the caller.

    preset: the name it began with. guidance: the scale. tolerance: None, or the error, RMS of the final
    picture in shares of display white, within which steps are chosen on the way; `steps` and `solver` are
    then not used.
    """

    preset: str = REFERENCE
    guidance: float = 1.0
    tolerance: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.guidance) and self.guidance >= 0):
            raise ValueError(f"guidance must be a number of at least 0, not {self.guidance}")
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, not {self.tolerance}")

    def facts(self) -> dict[str, Any]:
        """What decides the result, for its metadata."""
        unused = ("tolerance",) if self.tolerance is None else ("steps", "solver")
        return {name: value for name, value in asdict(self).items() if name not in unused}


def sampling(bundle: Bundle, preset: str | None = None, **asked: Any) -> Sampling:
    """How to walk the flow: by a preset's settings, over which those in `asked` go that are not None.

    Raises InputError for settings that cannot be, and BundleError.
    """
    preset, manifest = preset or REFERENCE, bundle.manifest
    began = Preset(manifest.steps)
    if preset != REFERENCE:
        presets = read_presets(bundle)
        if preset not in presets:
            known = ", ".join((REFERENCE, *presets))
            raise InputError(f"The model {manifest.name} has no preset {preset!r}, only: {known}.")
        began = presets[preset]
    given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if "tolerance" in given and given.keys() & {"steps", "solver"}:
        raise InputError("A tolerance chooses the steps and brings its own solver; leave the other two out.")
    try:
        own = Sampling(**vars(began), preset=preset, guidance=manifest.guidance)
        chosen = replace(own, **given)
    except ValueError as error:
        raise InputError(f"{error}.") from error
    if chosen.shift is not None and not isinstance(manifest.schedule, ShiftSchedule):
        raise InputError(
            f"The model {manifest.name} has a schedule whose shift is not for the caller to set."
        )
    if chosen.tolerance is not None and manifest.grid is None:
        raise InputError(
            f"The model {manifest.name} takes steps, not a tolerance: it predicts no light grid."
        )
    return chosen


def read_presets(bundle: Bundle) -> dict[str, Preset]:
    """The bundle's own presets by name; none where it has no presets.json. Raises BundleError."""
    if PRESETS not in bundle.manifest.files:
        return {}
    try:
        return parse(dict[str, Preset], read_json(bundle.folder / PRESETS, MOST_BYTES))
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot read {Path(bundle.folder, PRESETS)}: {reason(error)}.") from error
