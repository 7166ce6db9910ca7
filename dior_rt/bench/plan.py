"""The settings of a benchmark. Each changes one thing of the reference."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from dior_rt.bundle import Bundle
from dior_rt.flow.solvers import SOLVERS
from dior_rt.presets import REFERENCE, read_presets

STEPS = (1, 2, 4, 8, 16, 20)
QUICK_STEPS = (1, 4, 16)

#: The number of steps for the comparison of solvers.
SOLVER_STEPS = 8
INTERVALS = ((0.3, 1.0), (0.5, 1.0), (0.8, 1.0), (0.0, 0.8))
TOLERANCES = (0.5 / 255, 2 / 255)


@dataclass(frozen=True)
class Setting:
    """One way to relight.

    bundle: its folder. device, ops, threads: as for `Relighter`; None means all cores.
    preset, steps, solver, guidance, interval, tolerance: as for `Relighter.relight`. The preset decides
    where the value is None or the interval is empty.
    """

    bundle: str
    preset: str
    steps: int | None
    solver: str | None
    guidance: float
    interval: tuple[float, ...]
    tolerance: float | None
    device: str
    ops: str
    threads: int | None

    def name(self, reference: Setting) -> str:
        """Return what differs from the reference, such as "steps 8". Reports are compared by this name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed = [
            f"{name} {_short(value)}"
            for name, value in values.items()
            if value != getattr(reference, name) and value not in (None, ())
        ]
        return ", ".join(changed) or "reference"

    def takes_whole_cpu(self) -> bool:
        """Return whether all cores run the network, as they do in the roofline measurement."""
        return self.device == "cpu" and self.threads is None

    def how(self) -> dict[str, Any]:
        """Return the arguments of `Relighter.relight`."""
        names = ("preset", "steps", "solver", "guidance", "tolerance")
        return {name: getattr(self, name) for name in names} | {"interval": self.interval or None}


def reference_of(bundles: Sequence[Bundle], ops: str) -> Setting:
    """Return the reference: the first bundle in fp32, or else the first, with its own settings on the CPU."""
    bundle = next((bundle for bundle in bundles if bundle.manifest.precision == "fp32"), bundles[0])
    return _default_setting(bundle, ops)


def sweep(
    bundles: Sequence[Bundle],
    ops: Sequence[str],
    devices: Sequence[str],
    steps: Sequence[int] = STEPS,
    threads: Sequence[int] = (),
    ways: bool = False,
) -> list[Setting]:
    """Return the settings to compare, without duplicates, the reference first.

    ops: the first one is the reference's. ways: include solvers, guidance intervals and tolerances.
    A new kind of setting is one more line here.
    """
    reference = reference_of(bundles, ops[0])
    bundle_of_reference = next(bundle for bundle in bundles if str(bundle.folder) == reference.bundle)
    return list(
        dict.fromkeys(
            [
                reference,
                *(replace(reference, steps=count) for count in steps),
                replace(reference, guidance=1.0),  # one branch of the network instead of two
                *(_ways(reference, bundle_of_reference) if ways else ()),
                *(
                    replace(reference, preset=name, steps=None, solver=None)
                    for name in read_presets(bundle_of_reference)
                ),
                *(replace(reference, threads=count) for count in threads),
                *(replace(reference, ops=name) for name in ops),
                *(replace(reference, device=name) for name in devices),
                *(_default_setting(bundle, ops[0]) for bundle in bundles),
            ]
        )
    )


def usable_cores() -> int:
    """Return how many processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_counts(cores: int) -> list[int]:
    """Return the powers of two below the number of cores. The reference uses all cores.

    >>> thread_counts(1), thread_counts(2), thread_counts(12)
    ([], [1], [1, 2, 4, 8])
    """
    return [1 << power for power in range(cores.bit_length()) if 1 << power < cores]


def interleave(settings: Sequence[Setting], repeats: int) -> list[Setting]:
    """Return A B C A B C ..., so that a machine that slows down affects all settings alike."""
    return [setting for _ in range(repeats) for setting in settings]


def _ways(reference: Setting, bundle: Bundle) -> list[Setting]:
    """Return settings for solvers, guidance intervals and, on a light grid, tolerances."""
    few = min(SOLVER_STEPS, bundle.manifest.steps)
    return [
        *(replace(reference, steps=few, solver=name) for name in SOLVERS),
        *(replace(reference, interval=interval) for interval in INTERVALS),
        *(
            replace(reference, steps=None, solver=None, tolerance=tolerance)
            for tolerance in TOLERANCES
            if bundle.manifest.grid
        ),
    ]


def _default_setting(bundle: Bundle, ops: str) -> Setting:
    manifest = bundle.manifest
    return Setting(
        bundle=str(bundle.folder),
        preset=REFERENCE,
        steps=manifest.steps,
        solver="euler",
        guidance=manifest.guidance,
        interval=(),
        tolerance=None,
        device="cpu",
        ops=ops,
        threads=None,
    )


def _short(value: object) -> str:
    """Format a number with three digits, an interval by its ends."""
    if isinstance(value, tuple):
        return " to ".join(map(_short, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)
