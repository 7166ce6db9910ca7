"""The results of a benchmark as data, read from and written to JSON."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Final, Literal

from dior_rt.bench.difference import Difference
from dior_rt.bench.flops import step_flops, step_of
from dior_rt.bench.machine import Machine, Rooflines
from dior_rt.bench.plan import Setting
from dior_rt.bench.run import Measured, Outcome
from dior_rt.bench.worker import Pair
from dior_rt.bundle import Bundle
from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.images.photo import Photo
from dior_rt.records import parse, read_json, unparse

FORMAT: Final = 3
MOST_BYTES = 16 << 20


@dataclass(frozen=True)
class BundleFacts:
    """A bundle that was measured."""

    folder: str
    name: str
    precision: str
    sha256: str


@dataclass(frozen=True)
class PhotoFacts:
    """A photo of the benchmark, with the hashes of its file and of its strokes."""

    name: str
    sha256: str
    strokes_sha256: str
    height: int
    width: int
    bits: int


@dataclass(frozen=True)
class Result:
    """The time and the error of one setting.

    ratio: the reference's total seconds divided by this setting's.
    seconds, steps, start_up, start_up_cold, peak_bytes: see `Measured`.
    step_flops: the operations of one step, the mean over the photos.
    gemm_share: the rate of a step as a share of the machine's GEMM rate, if all CPU cores take part.
    product_share: the same, as a share of the rate of the network's own products.
    copy_share: see the function `copy_share`.
    None: unknown.
    """

    name: str
    setting: Setting
    ratio: float
    seconds: dict[str, float]
    steps: float
    per_step: float
    images_a_minute: float
    start_up: float
    start_up_cold: float
    peak_bytes: int | None
    difference: Difference
    step_flops: float | None
    gemm_share: float | None
    product_share: float | None
    copy_share: float


@dataclass(frozen=True, kw_only=True)
class Report:
    """One benchmark. results: the reference first. failed: setting -> why it failed."""

    format: Literal[3] = FORMAT
    machine: Machine
    bundles: tuple[BundleFacts, ...]
    photos: tuple[PhotoFacts, ...]
    repeats: int
    rooflines: Rooflines
    results: tuple[Result, ...]
    failed: dict[str, str]


def make_report(
    outcome: Outcome,
    machine: Machine,
    bundles: Sequence[Bundle],
    pairs: Sequence[Pair],
    photos: Sequence[Photo],
    repeats: int,
) -> Report:
    """Combine the measurements into a report. photos: those of the pairs, as read."""
    reference = next(iter(outcome.measured))
    return Report(
        machine=machine,
        bundles=tuple(
            BundleFacts(str(b.folder), b.manifest.name, b.manifest.precision, b.sha256) for b in bundles
        ),
        photos=tuple(map(_photo_facts, pairs, photos)),
        repeats=repeats,
        rooflines=outcome.rooflines,
        results=tuple(
            _result(setting, measured, outcome, bundles, photos)
            for setting, measured in outcome.measured.items()
        ),
        failed={setting.name(reference): why for setting, why in outcome.failed.items()},
    )


def copy_share(photo_bytes: float, seconds: float, bandwidth: float) -> float:
    """Return the share of the copy bandwidth that the kernels reach.

    The minimum is 3 x photo_bytes: the photo is read to reduce it, then read again and written to transfer
    the light. Strokes and tables count as overhead.
    """
    return 3 * photo_bytes / seconds / bandwidth


def write_report(path: Path, report: Report) -> None:
    """Write a complete JSON file or none. Raises InputError."""
    with replacing(path) as file:
        file.write((json.dumps(unparse(report), indent=2, allow_nan=False) + "\n").encode())


def read_report(path: Path) -> Report:
    """Read a report. Raises InputError if the file is missing or is not a report."""
    check_readable(path, "benchmark")
    try:
        return parse(Report, read_json(path, MOST_BYTES))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the benchmark {path}: {reason(error)}.") from error


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the points (seconds, decibels) that no other point dominates, sorted by seconds."""
    front, best = [], float("-inf")
    for index in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if points[index][1] > best:
            front.append(index)
            best = points[index][1]
    return front


def _result(
    setting: Setting, measured: Measured, outcome: Outcome, bundles: Sequence[Bundle], photos: Sequence[Photo]
) -> Result:
    reference = next(iter(outcome.measured))
    seconds = measured.seconds
    per_step = seconds["steps"] / measured.steps
    bundle = next(b for b in bundles if str(b.folder) == setting.bundle)
    # Other solvers may evaluate the network twice in a step, and intervals may skip a branch.
    alike = setting.solver == "euler" and not setting.interval
    each = [step_of(bundle, photo.size, setting.guidance) for photo in photos] if alike else []
    counts = {step: step_flops(bundle, step) for step in set(each) if step}
    flops = fmean(counts[step] for step in each if step) if counts else None
    rates = outcome.rooflines
    whole_cpu = setting.takes_whole_cpu()
    alone = (
        fmean(counts[step] / rates.products[step.name] for step in each if step)
        if counts and whole_cpu
        else None
    )
    return Result(
        name=setting.name(reference),
        setting=setting,
        ratio=outcome.measured[reference].seconds["total"] / seconds["total"],
        seconds=seconds,
        steps=measured.steps,
        per_step=per_step,
        images_a_minute=60 / seconds["total"],
        start_up=measured.start_up,
        start_up_cold=measured.start_up_cold,
        peak_bytes=measured.peak_bytes,
        difference=measured.difference,
        step_flops=flops,
        gemm_share=flops / per_step / rates.gemm if flops and whole_cpu else None,
        product_share=alone / per_step if alone else None,
        copy_share=copy_share(
            fmean(photo.pixels.nbytes for photo in photos),
            seconds["kernels"] + seconds["transfer"],
            rates.copy[setting.ops],
        ),
    )


def _photo_facts(pair: Pair, photo: Photo) -> PhotoFacts:
    return PhotoFacts(
        Path(pair.photo).name, _sha256(pair.photo), _sha256(pair.strokes), *photo.size, photo.bits
    )


def _sha256(path: str) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
