"""Run the settings of a plan in turns, each in its own process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from dior_rt.bench.difference import Difference, Distance, compare_pictures, worst
from dior_rt.bench.flops import Step, step_of
from dior_rt.bench.machine import Rooflines, measure_rooflines, medians
from dior_rt.bench.plan import Setting, interleave
from dior_rt.bench.worker import STAGES, Job, Pair, Sample
from dior_rt.bundle import Bundle, read_bundle
from dior_rt.errors import DeviceError, DiorError
from dior_rt.files import reason
from dior_rt.images.photo import read_photo
from dior_rt.presets import REFERENCE
from dior_rt.records import parse, unparse

Advance = Callable[[str], None]  # called before every run with its name

# The worker imports the same dior_rt as this process, whatever the working directory contains.
WORKER = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from dior_rt.bench.worker import main; main()"
)
#: The variables that locate compiled kernels: of pyopencl, of PoCL, of NVIDIA's driver.
CACHES = ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "CUDA_CACHE_PATH")


@dataclass(frozen=True)
class Measured:
    """A setting's medians over the repeats, and the worst photo's difference from the reference.

    seconds: of one photo, by stage, and their sum as "total". steps: how many were taken.
    start_up_cold: without any compiled kernel in a cache. start_up: with all of them.
    peak_bytes: the median peak of memory.
    """

    seconds: dict[str, float]
    steps: float
    start_up: float
    start_up_cold: float
    peak_bytes: int | None
    difference: Difference


@dataclass(frozen=True)
class Outcome:
    """measured: by setting, in the plan's order. failed: setting -> one sentence that says why it failed."""

    measured: dict[Setting, Measured]
    failed: dict[Setting, str]
    rooflines: Rooflines


def count_runs(settings: Sequence[Setting], repeats: int) -> int:
    """Return how often `measure` calls `advance` if nothing fails."""
    return len(set(map(_host, settings))) + repeats * (len(settings) + 1)


def measure(
    settings: Sequence[Setting],
    pairs: Sequence[Pair],
    repeats: int,
    advance: Advance,
    *,
    strict: bool = False,
    lpips: Distance | None = None,
) -> Outcome:
    """Measure the settings, of which the first is the reference, and the machine's rooflines.

    lpips: also measures the perceptual distance. strict: raise DeviceError if any setting fails, not only
    if the reference does. All settings are tried before the first is timed.
    """
    reference, steps = settings[0], _steps(settings, pairs)
    with tempfile.TemporaryDirectory(prefix="dior-bench-") as scratch:
        caches = {host: Path(scratch) / f"cache-{i}" for i, host in enumerate(map(_host, settings))}
        folders = {setting: Path(scratch) / f"pictures-{i}" for i, setting in enumerate(settings)}
        for folder in (*caches.values(), *folders.values()):
            folder.mkdir(exist_ok=True)
        failed: dict[Setting, str] = {}

        def attempt(setting: Setting, plan: Setting, pairs: Sequence[Pair]) -> list[Sample]:
            """Run `plan` for a setting, unless that setting has already failed."""
            if setting in failed:
                return []
            try:
                return [run(plan, pairs, folders[setting], caches[_host(setting)])]
            except DiorError as error:
                if strict or setting == reference:
                    raise
                failed[setting] = reason(error)
                return []

        cold: dict[Setting, Sample] = {}
        for setting in settings:
            host = _host(setting)
            if host not in cold:
                advance("cold start")
                for sample in attempt(setting, host, pairs[:1]):
                    cold[host] = sample
        samples: dict[Setting, list[Sample]] = {setting: [] for setting in settings}
        rooflines = []
        for setting in interleave(settings, repeats):
            if setting == reference:
                advance("rooflines")
                ops = sorted({one.ops for one in settings if one not in failed})
                rooflines.append(measure_rooflines(ops, steps))
            advance(setting.name(reference))
            samples[setting] += attempt(setting, setting, pairs)
        running = [setting for setting in settings if setting not in failed]
        differences = _differences(running, folders, len(pairs), lpips)
    measured = {
        setting: _summary(samples[setting], cold[_host(setting)], differences[setting]) for setting in running
    }
    return Outcome(measured, failed, medians(rooflines))


def run(setting: Setting, pairs: Sequence[Pair], out: Path, cache: Path) -> Sample:
    """Run once in a new process. Its pictures go to `out`, its compiled kernels to `cache`.

    Raises DeviceError with the error of the process, or with its exit code.
    """
    job = Job(setting, tuple(pairs), str(out), time.monotonic())
    process = subprocess.run(
        [sys.executable, "-c", WORKER, json.dumps(sys.path)],
        input=json.dumps(unparse(job)),
        capture_output=True,
        text=True,
        env=os.environ | dict.fromkeys(CACHES, str(cache)),
    )
    try:
        answer = json.loads(process.stdout.splitlines()[-1])
        if "error" in answer:
            raise DeviceError(answer["error"])
        return parse(Sample, answer)
    except (ValueError, IndexError, TypeError):
        output = process.stderr.strip().splitlines() or ["it printed nothing"]
        where = f"{setting.device} and {setting.ops}"
        raise DeviceError(f"The run on {where} ended with code {process.returncode}: {output[-1]}.") from None


def _steps(settings: Sequence[Setting], pairs: Sequence[Pair]) -> dict[Step, Bundle]:
    """Return the steps that all CPU cores work on, and their bundles: those whose products are measured."""
    sizes = {read_photo(Path(pair.photo)).size for pair in pairs}
    found: dict[Step, Bundle] = {}
    for folder, guidance in {(one.bundle, one.guidance) for one in settings if one.takes_whole_cpu()}:
        bundle = read_bundle(Path(folder))
        steps = [step_of(bundle, size, guidance) for size in sizes]
        found |= {step: bundle for step in steps if step}
    return found


def _host(setting: Setting) -> Setting:
    """Return the part of a setting that its start-up depends on; everything else is minimal."""
    return replace(
        setting,
        preset=REFERENCE,
        steps=1,
        solver="euler",
        guidance=1.0,
        interval=(),
        tolerance=None,
        threads=None,
    )


def _differences(
    settings: Sequence[Setting], folders: dict[Setting, Path], photos: int, lpips: Distance | None
) -> dict[Setting, Difference]:
    found: dict[Setting, list[Difference]] = {setting: [] for setting in settings}
    for index in range(photos):
        reference = read_photo(folders[settings[0]] / f"{index}.png").pixels
        for setting in settings:
            picture = read_photo(folders[setting] / f"{index}.png").pixels
            found[setting].append(compare_pictures(picture, reference, lpips))
    return {setting: worst(differences) for setting, differences in found.items()}


def _summary(samples: Sequence[Sample], cold: Sample, difference: Difference) -> Measured:
    seconds = {stage: median(sample.seconds[stage] for sample in samples) for stage in STAGES}
    # The total is the median of the sums, so that stages that are slow in different runs do not cancel out.
    seconds["total"] = median(sum(sample.seconds.values()) for sample in samples)
    peaks = [sample.peak_bytes for sample in samples if sample.peak_bytes is not None]
    return Measured(
        seconds,
        samples[0].steps,
        median(sample.start_up for sample in samples),
        cold.start_up,
        int(median(peaks)) if peaks else None,
        difference,
    )
