"""Check what presets promise (the PSNR to the reference in the worst of many cases), and find presets."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.bench.cases import Case
from dior_rt.bench.difference import compare_pictures
from dior_rt.bundle import Bundle, write_bundle
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.flow.solvers import SOLVERS
from dior_rt.presets import ALWAYS, PRESETS, PROMISES, Preset
from dior_rt.relight import Relighter, Relit

IDENTICAL: Final = 100.0  # dB for a picture without any difference
MARGIN: Final = 1.0  # dB of reserve for cases that were not measured

STEPS: Final = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32, 36, 40)
SHIFTS: Final = (2.0, 3.0, 5.0, 8.0)
NEVER: Final = (0.0, 0.0)
INTERVALS: Final = (ALWAYS, (0.3, 1.0), (0.5, 1.0), (0.7, 1.0), (0.9, 1.0), (0.0, 0.9), (0.3, 0.9), NEVER)


@dataclass(frozen=True)
class Kept:
    """How well a preset keeps its promise.

    worst, median: dB to the reference over the cases. speed: the median ratio of the reference's seconds to
    the preset's, in the sampler alone and in total. steps: the fewest and the most that were taken.
    """

    worst: float
    median: float
    steps_speed: float
    speed: float
    steps: tuple[int, int]


def settings(preset: Preset) -> dict[str, Any]:
    """Return a preset as arguments of `Relighter.relight`, independent of the bundle's presets."""
    return asdict(preset)


def relight(relighter: Relighter, case: Case, **how: Any) -> Relit:
    return relighter.relight(case.photo, case.strokes, seed=case.seed, **how)


def decibels(relit: Relit, reference: NDArray) -> float:
    """Return the PSNR of a relit picture to the reference's."""
    psnr = compare_pictures(np.asarray(relit.picture), reference).psnr
    return IDENTICAL if psnr is None else psnr


def keep(
    relighter: Relighter,
    cases: Sequence[Case],
    ways: Mapping[str, Mapping[str, Any]],
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Kept]:
    """Relight every case with the reference and with every setting, in turns."""
    found: dict[str, list[tuple[float, float, float, int]]] = {name: [] for name in ways}
    relight(relighter, cases[0], steps=2)  # warm up threads and caches
    for case in cases:
        reference, seconds = _timed(relighter, case, {})
        for name, how in ways.items():
            relit, spent = _timed(relighter, case, how)
            found[name].append(
                (
                    decibels(relit, np.asarray(reference.picture)),
                    reference.seconds["steps"] / relit.seconds["steps"],
                    seconds / spent,
                    relit.steps,
                )
            )
        advance()
    return {name: _kept(rows) for name, rows in found.items()}


def cost(preset: Preset, bundle: Bundle) -> int:
    """Return how many network branches a picture runs."""
    manifest = bundle.manifest
    schedule = ShiftSchedule(preset.shift) if preset.shift else manifest.schedule
    assert isinstance(schedule, ShiftSchedule)
    sigmas, asks = schedule.sigmas(preset.steps).tolist(), SOLVERS[preset.solver].asks
    asked = sigmas[:1] + sigmas[1:-1] * asks
    low, high = preset.interval
    if manifest.guidance in (0, 1):
        return len(asked)
    return sum(2 if low <= sigma <= high else 1 for sigma in asked)


def candidates(bundle: Bundle) -> list[Preset]:
    """Return all candidates, cheapest first."""
    manifest = bundle.manifest
    assert isinstance(manifest.schedule, ShiftSchedule)
    shifts = (None, *(shift for shift in SHIFTS if shift != manifest.schedule.shift))
    intervals = (ALWAYS,) if manifest.guidance in (0, 1) else INTERVALS
    steps = [count for count in STEPS if count <= manifest.steps]
    tried = [Preset(*choice) for choice in product(steps, SOLVERS, shifts, intervals)]
    return sorted(tried, key=lambda preset: cost(preset, bundle))


def find(relighter: Relighter, cases: Sequence[Case], say: Callable[[str], None]) -> dict[str, Preset]:
    """Return the cheapest candidate that keeps each promise with a margin in every case, or the reference."""
    found, full = {}, Preset(relighter.bundle.manifest.steps)
    left = iter(candidates(relighter.bundle))
    references: dict[int, NDArray] = {}
    hardest = list(range(len(cases)))  # cases that failed a candidate come first
    kept, cheapest = 0.0, full
    for name, promise in sorted(PROMISES.items(), key=lambda item: item[1]):
        if kept >= promise + MARGIN:  # the preset of a weaker promise also keeps this one
            found[name] = cheapest
            continue
        found[name] = full
        for candidate in _cheaper(left, relighter.bundle, full):
            worst = IDENTICAL
            for index in list(hardest):
                case = cases[index]
                if index not in references:
                    references[index] = np.asarray(relight(relighter, case).picture)
                worst = min(
                    worst, decibels(relight(relighter, case, **settings(candidate)), references[index])
                )
                if worst < promise + MARGIN:
                    hardest.remove(index)
                    hardest.insert(0, index)
                    break
            else:
                say(f"{name}: {candidate} keeps {worst:.1f} dB")
                found[name], cheapest, kept = candidate, candidate, worst
                break
    return found


def write_presets(bundle: Bundle, presets: Mapping[str, Preset]) -> Bundle:
    """Write presets into a bundle, in place. Raises BundleError."""
    files = {name: bundle.folder / name for name in bundle.manifest.files}
    with tempfile.TemporaryDirectory() as folder:
        files[PRESETS] = Path(folder) / PRESETS
        text = json.dumps({name: asdict(preset) for name, preset in presets.items()}, indent=2)
        files[PRESETS].write_text(text + "\n", encoding="utf-8")
        return write_bundle(bundle.folder, bundle.manifest, files, overwrite=True)


def _cheaper(left: Iterator[Preset], bundle: Bundle, full: Preset) -> Iterator[Preset]:
    """Return the candidates that cost less than the reference."""
    return (candidate for candidate in left if cost(candidate, bundle) < cost(full, bundle))


def _timed(relighter: Relighter, case: Case, how: Mapping[str, Any]) -> tuple[Relit, float]:
    # The model caches its last photo, so another one is relit in between.
    relight(relighter, replace(case, photo=np.ascontiguousarray(case.photo[:, ::-1])), steps=1)
    start = perf_counter()
    relit = relight(relighter, case, **how)
    return relit, perf_counter() - start


def _kept(rows: Sequence[tuple[float, float, float, int]]) -> Kept:
    errors, steps_speed, speed, steps = zip(*rows, strict=True)
    return Kept(min(errors), median(errors), median(steps_speed), median(speed), (min(steps), max(steps)))
