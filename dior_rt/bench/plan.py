"""What is run: settings, each of which changes one thing of the reference."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from dior_rt.bundle import Bundle

STEPS = (1, 2, 4, 8, 16, 20)
QUICK_STEPS = (1, 4, 16)


@dataclass(frozen=True)
class Setting:
    """One way to relight. bundle: its folder. device, ops, threads: as for `Relighter`; None is all cores."""

    bundle: str
    steps: int
    guidance: float
    device: str
    ops: str
    threads: int | None

    def name(self, reference: Setting) -> str:
        """What differs from the reference, such as "steps 8"; by it reports are compared."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed = [
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in values.items()
            if value != getattr(reference, name)
        ]
        return ", ".join(changed) or "reference"


def reference_of(bundles: Sequence[Bundle], ops: str) -> Setting:
    """The reference: the first bundle in fp32, else the first; its own steps and guidance, on the CPU."""
    bundle = next((bundle for bundle in bundles if bundle.manifest.precision == "fp32"), bundles[0])
    return _own(bundle, ops)


def sweep(
    bundles: Sequence[Bundle],
    ops: Sequence[str],
    devices: Sequence[str],
    steps: Sequence[int] = STEPS,
    threads: Sequence[int] = (),
) -> list[Setting]:
    """The settings to compare, the reference first, none twice. A new kind of setting is one more line here.

    ops: the reference's first.
    """
    reference = reference_of(bundles, ops[0])
    return list(
        dict.fromkeys(
            [
                reference,
                *(replace(reference, steps=count) for count in steps),
                replace(reference, guidance=1.0),  # one branch of the network instead of two
                *(replace(reference, threads=count) for count in threads),
                *(replace(reference, ops=name) for name in ops),
                *(replace(reference, device=name) for name in devices),
                *(_own(bundle, ops[0]) for bundle in bundles),
            ]
        )
    )


def usable_cores() -> int:
    """The processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_counts(cores: int) -> list[int]:
    """The powers of two below the number of cores; all of them is what the reference takes.

    >>> thread_counts(1), thread_counts(2), thread_counts(12)
    ([], [1], [1, 2, 4, 8])
    """
    return [1 << power for power in range(cores.bit_length()) if 1 << power < cores]


def interleave(settings: Sequence[Setting], repeats: int) -> list[Setting]:
    """A B C A B C ...: a machine that slows down during the run slows down all settings alike."""
    return [setting for _ in range(repeats) for setting in settings]


def _own(bundle: Bundle, ops: str) -> Setting:
    manifest = bundle.manifest
    return Setting(str(bundle.folder), manifest.steps, manifest.guidance, "cpu", ops, None)
