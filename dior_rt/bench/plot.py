"""Plot speed against error. Needs matplotlib, from the extra `bench`."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from dior_rt.bench.report import Report, pareto_front
from dior_rt.files import replacing

ROOM = 6.0  # dB between the highest figure and the line of identical results


def plot(path: Path, report: Report) -> None:
    """Draw every setting at (seconds per photo, PSNR to the reference), and the Pareto front.

    Writes a complete PNG or none. Raises InputError if it cannot be written.
    """
    decibels = [result.difference.psnr for result in report.results]
    identical = max((value for value in decibels if value is not None), default=0.0) + ROOM
    points = [
        (result.seconds["total"], identical if value is None else value)
        for result, value in zip(report.results, decibels, strict=True)
    ]
    front = [points[index] for index in pareto_front(points)]
    figure = Figure(figsize=(8, 5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.axhline(
        identical, color="tab:gray", linewidth=0.8, linestyle="--", label="identical to the reference"
    )
    axes.step(
        *zip(*front, strict=True), where="post", color="tab:orange", label="no setting is faster and closer"
    )
    axes.plot(*zip(*points, strict=True), "o", color="tab:gray")
    axes.plot(*zip(*front, strict=True), "o", color="tab:orange")
    middle = (min(points)[0] * max(points)[0]) ** 0.5
    for result, point in zip(report.results, points, strict=True):
        right = point[0] > middle  # labels extend towards the middle and stay inside
        axes.annotate(
            result.name,
            point,
            xytext=(-5 if right else 5, 5),
            textcoords="offset points",
            ha="right" if right else "left",
            fontsize=8,
        )
    axes.set_xscale("log", subs=[1.5, 2, 3, 5, 7])
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(
        StrMethodFormatter("{x:g}") if max(points)[0] < 100 * min(points)[0] else NullFormatter()
    )
    axes.set_xlabel("seconds per photo")
    axes.set_ylabel("PSNR to the reference, dB")
    machine = report.machine
    axes.set_title(
        f"{report.bundles[0].name} on {machine.cpu}, cores: {machine.usable_cores}", fontsize="medium"
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=8)
    with replacing(path) as file:
        FigureCanvasAgg(figure).print_png(file)
