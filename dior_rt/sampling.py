"""How the flow is sampled: the caller's options, and the settings that result from them for one bundle."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Final, TypedDict

from dior_rt.bundle import Bundle
from dior_rt.errors import InputError
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.presets import REFERENCE, Preset, read_presets

#: The largest guidance and noise scale: far beyond any use, and still small enough for the network's results
#: in float32.
MOST_SCALE: Final = 1000.0


@dataclass(frozen=True)
class SamplingOptions:
    """The caller's options for the sampler. A field that is None is left to the preset, then to the model."""

    #: "reference", or the name of one of the model's presets, such as "fast".
    preset: str | None = None
    #: Number of solver steps.
    steps: int | None = None
    #: Name of the solver, a key of `dior_rt.flow.solvers.SOLVERS`.
    solver: str | None = None
    #: Shift of the schedule of sigmas: above 1, more of the steps lie near noise.
    shift: float | None = None
    #: Scale of classifier-free guidance: 1 is the condition alone, 0 is no strokes at all.
    guidance: float | None = None
    #: The sigmas (low, high), both ends included, at which guidance acts.
    interval: tuple[float, float] | None = None
    #: RMS error of the final picture, as a share of display white, within which steps are chosen on the way.
    tolerance: float | None = None
    #: Standard deviation of the starting noise: 1 draws from the posterior, 0 starts at the noise's mean.
    noise_scale: float | None = None

    def override(self, **fields: Any) -> SamplingOptions:
        """Return a copy in which every passed field that is not None replaces this one's.

        Raises TypeError for a name that is not a field.
        """
        changes = SamplingOptions(**fields)
        return replace(self, **{name: value for name, value in vars(changes).items() if value is not None})


DEFAULTS: Final = SamplingOptions()


class SamplingFields(TypedDict, total=False):
    """The fields of SamplingOptions as keywords."""

    preset: str | None
    steps: int | None
    solver: str | None
    shift: float | None
    guidance: float | None
    interval: tuple[float, float] | None
    tolerance: float | None
    noise_scale: float | None


@dataclass(frozen=True)
class Sampling(Preset):
    """SamplingOptions resolved for one bundle: no field is left open. Raises ValueError.

    Where `tolerance` is not None, `steps` and `solver` are not used.
    """

    #: Name of the preset that the other fields started from.
    preset: str = REFERENCE
    #: Scale of classifier-free guidance.
    guidance: float = 1.0
    #: As in SamplingOptions; None means a fixed number of steps.
    tolerance: float | None = None
    #: Standard deviation of the starting noise.
    noise_scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("guidance", self.guidance), ("noise_scale", self.noise_scale)):
            if not 0 <= value <= MOST_SCALE:
                raise ValueError(f"{name} must lie between 0 and {MOST_SCALE:g}, not {value:g}")
        if self.tolerance is not None and not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, not {self.tolerance}")

    def facts(self) -> dict[str, Any]:
        """Return the fields that decide the result, for its metadata."""
        unused = ("tolerance",) if self.tolerance is None else ("steps", "solver")
        return {name: value for name, value in asdict(self).items() if name not in unused}


def resolve_sampling(bundle: Bundle, options: SamplingOptions = DEFAULTS) -> Sampling:
    """Return a bundle's sampling settings: the model's, overridden by the preset's, then by the options.

    Raises InputError for options that are not valid for this bundle, and BundleError.
    """
    manifest = bundle.manifest
    preset = _find_preset(bundle, options.preset or REFERENCE)
    asked = {name: value for name, value in vars(options).items() if value is not None and name != "preset"}
    if "tolerance" in asked and asked.keys() & {"steps", "solver"}:
        raise InputError("A tolerance chooses the steps and brings its own solver; leave the other two out.")
    try:
        start = Sampling(
            **vars(preset),
            preset=options.preset or REFERENCE,
            guidance=manifest.guidance,
            noise_scale=manifest.noise_scale,
        )
        resolved = replace(start, **asked)
    except ValueError as error:
        raise InputError(f"{error}.") from error
    if resolved.shift is not None and not isinstance(manifest.schedule, ShiftSchedule):
        raise InputError(
            f"The model {manifest.name} has a schedule whose shift is not for the caller to set."
        )
    if resolved.tolerance is not None and manifest.grid is None:
        raise InputError(
            f"The model {manifest.name} takes steps, not a tolerance: it predicts no light grid."
        )
    return resolved


def _find_preset(bundle: Bundle, name: str) -> Preset:
    """Return a preset by name. The reference is the model's own number of steps."""
    if name == REFERENCE:
        return Preset(bundle.manifest.steps)
    presets = read_presets(bundle)
    if name not in presets:
        names = ", ".join((REFERENCE, *presets))
        raise InputError(f"The model {bundle.manifest.name} has no preset {name!r}, only: {names}.")
    return presets[name]
