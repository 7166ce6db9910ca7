"""Show a report as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from dior_rt.bench.report import Report, Result


def as_markdown(report: Report) -> str:
    """Return the report: ratios and errors, then where the time goes, then the machine."""
    speed = [
        [
            result.name,
            f"{result.ratio:.2f}",
            _decibels(result),
            f"{result.difference.largest:.1f}",
            _percent(result.difference.light, 2),
            "" if result.difference.lpips is None else f"{result.difference.lpips:.4f}",
            f"{result.seconds['total']:.3f}",
            f"{result.images_a_minute:.1f}",
            "?" if result.peak_bytes is None else f"{result.peak_bytes / 1e6:.0f}",
        ]
        for result in report.results
    ]
    heads = [
        "setting", "times as fast", "PSNR, dB", "largest, 1/255", "light error", "LPIPS",
        "s a photo", "photos a minute", "peak, MB",
    ]  # fmt: skip
    stages = [
        [
            result.name,
            *(f"{result.seconds[stage]:.3f}" for stage in ("read", "kernels")),
            f"{result.steps:g}",
            f"{result.per_step:.4f}",
            *(f"{result.seconds[stage]:.3f}" for stage in ("transfer", "write")),
            f"{result.start_up_cold:.2f}",
            f"{result.start_up:.2f}",
            _percent(result.gemm_share, 1),
            _percent(result.product_share, 1),
            _percent(result.copy_share, 1),
        ]
        for result in report.results
    ]
    where = [
        "seconds", "read", "kernels", "steps", "a step", "transfer", "write", "start-up cold", "warm",
        "of GEMM", "of its products", "of copy",
    ]  # fmt: skip
    return "\n\n".join([table(heads, speed), table(where, stages), "\n".join(_facts(report))])


def compare(new: Report, old: Report) -> str:
    """Return new divided by old for the settings in both reports, and what else differs."""
    before = {result.name: result for result in old.results}
    rows = [
        [
            result.name,
            f"{result.seconds['total'] / before[result.name].seconds['total']:.3f}",
            f"{result.per_step / before[result.name].per_step:.3f}",
            f"{result.start_up / before[result.name].start_up:.3f}",
            _ratio(result.peak_bytes, before[result.name].peak_bytes),
            f"{_decibels(before[result.name])} -> {_decibels(result)}",
        ]
        for result in new.results
        if result.name in before
    ]
    heads = ["new / old", "seconds", "a step", "start-up", "peak memory", "PSNR, dB"]
    notes = [f"- differs: {', '.join(changed)}" for changed in [_changed(new, old)] if changed]
    return "\n\n".join([table(heads, rows) if rows else "No setting is in both benchmarks.", *notes])


def _facts(report: Report) -> list[str]:
    machine, rooflines, reference = report.machine, report.rooflines, report.results[0]
    memory = "unknown memory" if machine.memory_bytes is None else f"{machine.memory_bytes / 2**30:.1f} GiB"
    setting = reference.setting
    copies = ", ".join(f"{name} {rate / 1e9:.1f} GB/s" for name, rate in rooflines.copy.items())
    return [
        f"- reference: {setting.steps} steps of Euler, guidance {setting.guidance:g}, {setting.device},"
        f" kernels {setting.ops}; errors are the worst photo's against it",
        f"- photos: {', '.join(f'{p.name} ({p.width} x {p.height}, {p.bits} bits)' for p in report.photos)};"
        f" medians of {report.repeats} interleaved",
        *(f"- bundle: {b.name}, {b.precision}, manifest {b.sha256[:12]}, {b.folder}" for b in report.bundles),
        f"- rooflines: GEMM {rooflines.gemm / 1e9:.1f} GFLOP/s; copy {copies}",
        *(
            f"- roofline: products of {name}: {rate / 1e9:.1f} GFLOP/s"
            for name, rate in rooflines.products.items()
        ),
        f"- machine: {machine.cpu}, {machine.usable_cores} of {machine.cores} cores, {memory},"
        f" {machine.system}",
        f"- versions: {', '.join(f'{name} {version}' for name, version in machine.versions.items())}",
        *(f"- not measured: {name}: {why}" for name, why in report.failed.items()),
    ]


def _changed(new: Report, old: Report) -> list[str]:
    pairs = {
        "machine": (new.machine, old.machine),
        "bundles": ([b.sha256 for b in new.bundles], [b.sha256 for b in old.bundles]),
        "photos": (new.photos, old.photos),
        "reference": (new.results[0].setting, old.results[0].setting),
    }
    return [name for name, (new, old) in pairs.items() if new != old]


def _decibels(result: Result) -> str:
    psnr = result.difference.psnr
    return "identical" if psnr is None else f"{psnr:.1f}"


def _percent(share: float | None, digits: int) -> str:
    return "" if share is None else f"{share:.{digits}%}"


def _ratio(new: float | None, old: float | None) -> str:
    return f"{new / old:.3f}" if new and old else "?"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with aligned columns."""
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [heads, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |"
        for line in lines
    )
