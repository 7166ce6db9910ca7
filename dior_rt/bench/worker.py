"""Run one setting once, in a process whose peak memory and start-up time are measured.

The process reads a Job as JSON from its input. The last line of its output is a Sample, or {"error":
sentence}.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from dior_rt.bench.plan import Setting
from dior_rt.errors import DiorError, InputError
from dior_rt.records import parse, unparse
from dior_rt.stopwatch import Stopwatch


@dataclass(frozen=True)
class Pair:
    """The files of a photo and of its strokes."""

    photo: str
    strokes: str


@dataclass(frozen=True)
class Job:
    """One run. out: the folder for the pictures 0.png, 1.png ... spawned: `time.monotonic()` of the parent
    when it started this process; all processes share this clock."""

    setting: Setting
    pairs: tuple[Pair, ...]
    out: str
    spawned: float


@dataclass(frozen=True)
class Sample:
    """The measurements of one run.

    seconds: per photo, the mean over the photos, by stage: read, kernels, steps, transfer, write.
    steps: how many were taken, the mean over the photos.
    start_up: from the start of the process to the end of the first step, including loading.
    peak_bytes: the most memory that the process held at once; None if the system does not report it.
    """

    seconds: dict[str, float]
    steps: float
    start_up: float
    peak_bytes: int | None


STAGES = ("read", "kernels", "steps", "transfer", "write")


def work(job: Job) -> Sample:
    """Relight every pair once to warm up, with a single step, and once for the clock.

    The warm-up uses the photo's mirror image, because the model caches its last photo.
    """
    import numpy as np

    from dior_rt.relight import Relighter

    setting, sums, taken, started = job.setting, dict.fromkeys(STAGES, 0.0), 0, []
    relighter = Relighter(setting.bundle, setting.device, setting.ops, setting.threads)

    def first_step(step: int, steps: int) -> None:
        started.append(time.monotonic() - job.spawned)

    from dior_rt.images.photo import read_photo, write_photo
    from dior_rt.images.strokes import read_strokes

    for index, pair in enumerate(job.pairs):
        watch = Stopwatch()
        photo = read_photo(Path(pair.photo))
        strokes = read_strokes(Path(pair.strokes), photo.size)
        watch.lap("read")
        mirrored = np.ascontiguousarray(photo.pixels[:, ::-1])
        relighter.relight(mirrored, strokes, steps=1, guidance=setting.guidance, progress=first_step)
        relit = relighter.relight(photo.pixels, strokes, **setting.how())
        taken += relit.steps
        if relit.notice:
            raise InputError(f"{pair.strokes} cannot be measured with: {relit.notice}")
        watch.lap("relight")
        write_photo(Path(job.out) / f"{index}.png", photo.with_pixels(np.asarray(relit.picture)), {})
        watch.lap("write")
        for stage in STAGES:
            sums[stage] += (watch.seconds | relit.seconds)[stage]
    means = {stage: total / len(job.pairs) for stage, total in sums.items()}
    return Sample(means, taken / len(job.pairs), started[0], peak_memory())


def peak_memory() -> int | None:
    """Return the most bytes of memory that this process held at once."""
    try:
        # On Linux, getrusage starts with the parent's peak at the fork, so VmHWM is better.
        status = Path("/proc/self/status").read_text()
        return next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def main() -> None:
    """Run the process."""
    try:
        answer = unparse(work(parse(Job, json.load(sys.stdin))))
    except DiorError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer))
