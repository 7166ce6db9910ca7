"""The command that measures speed against error."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dior_rt.cli import options
from dior_rt.errors import DeviceError, InputError
from dior_rt.extras import needs_extra

if TYPE_CHECKING:
    from dior_rt.bench.difference import Distance
    from dior_rt.bench.worker import Pair


def bench(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[PHOTO STROKES]...", help="[default: a synthetic photo]", show_default=False),
    ] = None,
    bundle: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER", help="A model; may be repeated [default: the one that ships with dior-rt]."
        ),
    ] = None,
    device: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="What runs the network; may be repeated [default: all there are]."),
    ] = None,
    ops: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="What works on pixels; may be repeated [default: all there are]."),
    ] = None,
    steps: Annotated[
        list[int] | None,
        typer.Option(min=1, max=1000, help="Steps of the sampler; may be repeated [default: 1 2 4 8 16 20]."),
    ] = None,
    megapixels: Annotated[
        float, typer.Option(min=0.0001, max=178, help="The size of the synthetic photo.")
    ] = 1.0,
    repeats: Annotated[int | None, typer.Option(min=1, help="Runs of each setting [default: 5].")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few settings, run once: under a minute.")] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write everything that was measured.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw speed against error; needs dior-rt[bench].")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(metavar="OLD.json", help="Print the ratios to an older benchmark.")
    ] = None,
    lpips: Annotated[
        bool, typer.Option("--lpips", help="Also the error that the eye sees; needs dior-rt[lpips].")
    ] = False,
    debug: options.Debug = False,
) -> None:
    """Measure speed and, against the reference run, error: of steps, solvers, presets, devices and kernels.

    The reference takes all of the model's steps, on the CPU. Every run is a process of its own; settings take
    turns, and medians are printed, as a table in Markdown.

    \b
      dior-rt bench --quick
      dior-rt bench photo.jpg strokes.png --json today.json --plot today.png
      dior-rt bench --bundle mini --bundle mini-int8 --compare yesterday.json
    """
    from dior_rt.bench.machine import this_machine
    from dior_rt.bench.plan import QUICK_STEPS, STEPS, sweep, thread_counts, usable_cores
    from dior_rt.bench.report import make_report, read_report, write_report
    from dior_rt.bench.run import count_runs, measure
    from dior_rt.bench.tables import as_markdown
    from dior_rt.bench.tables import compare as compare_reports
    from dior_rt.bundle import default_bundle, read_bundle
    from dior_rt.files import check_writable
    from dior_rt.images.photo import read_photo
    from dior_rt.providers import available

    if plot:
        with needs_extra("bench"):
            from dior_rt.bench.plot import plot as draw
        if plot.suffix.lower() != ".png":
            raise InputError(f"Cannot write {plot}: a plot is a .png file.")
    distance = _lpips() if lpips else None
    for path in filter(None, (json_file, plot)):
        check_writable(path)
    old = read_report(compare) if compare else None
    bundles = [read_bundle(folder) for folder in bundle or [default_bundle()]]
    repeats = repeats or (1 if quick else 5)
    settings = sweep(
        bundles,
        _kernels(ops, usable_only=bool(device)),
        device or available(),
        steps or (QUICK_STEPS if quick else STEPS),
        () if quick else thread_counts(usable_cores()),
        ways=not quick,
    )
    with ExitStack() as stack:
        pairs = _pairs(files or [], stack, megapixels)
        photos = [read_photo(Path(pair.photo)) for pair in pairs]
        with _progress(count_runs(settings, repeats)) as advance:
            outcome = measure(settings, pairs, repeats, advance, strict=bool(device or ops), lpips=distance)
        report = make_report(outcome, this_machine(), bundles, pairs, photos, repeats)
    typer.echo(as_markdown(report))
    if old:
        typer.echo(f"\n{compare_reports(report, old)}")
    if json_file:
        write_report(json_file, report)
    if plot:
        draw(plot, report)


def _kernels(asked: list[str] | None, usable_only: bool) -> list[str]:
    """Return the pixel kernels to measure. The first is the reference: the best, or the first requested.

    usable_only: leave out OpenCL devices that nobody requested and that cannot be opened. Otherwise the
    report lists them; but where a network's device is requested, a setting that fails ends the benchmark.
    """
    from dior_rt.kernels import KernelError, list_devices, open_ops

    try:
        if asked:
            return list(dict.fromkeys(_short(open_ops(name).name) for name in asked))
        best = _short(open_ops("auto").name)
    except KernelError as error:
        raise DeviceError(str(error)) from error
    try:
        devices = [f"opencl:{device.index}" for device in list_devices()]
    except KernelError:  # there is no OpenCL
        devices = []
    if usable_only:
        devices = [name for name in devices if _opens(name)]
    return list(dict.fromkeys([best, *devices, "numpy"]))


def _opens(name: str) -> bool:
    from dior_rt.kernels import KernelError, open_ops

    try:
        open_ops(name)
    except KernelError:
        return False
    return True


def _lpips() -> Distance:
    """Return LPIPS with AlexNet, as most papers report it."""
    with needs_extra("lpips", "bench --lpips"):
        from dior_rt.training.evaluation.lpips import Lpips
    return Lpips("alex")


def _short(name: str) -> str:
    """Return opencl:0 for "opencl:0 (the device's name)"."""
    return name.partition(" ")[0]


def _pairs(files: list[Path], stack: ExitStack, megapixels: float) -> list[Pair]:
    """Return the named photos and strokes, or a synthetic pair that exists as long as the stack."""
    from dior_rt.bench.scene import write_scene
    from dior_rt.bench.worker import Pair

    if len(files) % 2:
        raise InputError(f"Every photo needs its strokes: {files[-1]} stands alone.")
    if files:
        named = [str(file.resolve()) for file in files]
        return [Pair(*pair) for pair in zip(named[::2], named[1::2], strict=True)]
    return [write_scene(Path(stack.enter_context(tempfile.TemporaryDirectory())), megapixels)]


@contextmanager
def _progress(runs: int) -> Iterator[Callable[[str], None]]:
    """Yield a callback that moves a bar on a terminal, and does nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda name: None
        return
    with typer.progressbar(length=runs, label="Measuring", file=sys.stderr) as bar:
        begun = iter(range(runs))

        def advance(name: str) -> None:
            bar.label = f"Measuring {name}"
            bar.update(next(begun) - bar.pos)  # called before a run, so the bar shows the finished runs

        yield advance
        bar.update(runs - bar.pos)
