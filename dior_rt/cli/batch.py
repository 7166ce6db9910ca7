"""The command that relights many photos."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from dior_rt.cli import options
from dior_rt.cli.text import say
from dior_rt.errors import InputError

if TYPE_CHECKING:
    from dior_rt.batch.plan import Plan
    from dior_rt.batch.progress import Progress

SOME_FAILED: Final = 1


def batch(
    photos: Annotated[
        list[str],
        typer.Argument(
            metavar="IN...",
            help="Photos, folders, patterns in quotes such as 'day*/*.jpg', or - for a list of names on "
            "standard input.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="The folder of the results.")],
    strokes: Annotated[
        Path | None,
        typer.Option(
            "--strokes",
            metavar="FILE|FOLDER",
            help="One drawing for all photos, or a folder with one for each [default: beside each photo].",
        ),
    ] = None,
    format: options.Format = None,
    bundle: options.Bundle = None,
    device: options.Device = "auto",
    ops: options.Ops = "auto",
    preset: options.Preset = None,
    steps: options.Steps = None,
    solver: options.Solver = None,
    shift: options.Shift = None,
    guidance: options.Guidance = None,
    interval: options.Interval = None,
    tolerance: options.Tolerance = None,
    seed: options.Seed = 0,
    intensity: options.Intensity = 1.0,
    reach: options.Reach = None,
    key: Annotated[
        Literal["black"] | None,
        typer.Option(help="Read what is exactly black in the strokes as unspecified."),
    ] = None,
    quality: options.Quality = None,
    bits: options.Bits = None,
    sidecar: options.Sidecar = False,
    at_once: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Photos that are relit at a time [default: by model and device]."),
    ] = None,
    in_flight: Annotated[
        float,
        typer.Option(
            min=0.1, metavar="MEGAPIXELS", help="All photos in memory together; a larger one goes alone."
        ),
    ] = 100.0,
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="Relight on this machine, or on a cluster of Ray.")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of Ray's cluster [default: one of its own on this machine]."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")
    ] = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Relight many photos, each by the strokes that go with it, into a folder.

    The strokes of a.jpg are a.json, a.npy, a.dior, or a-light or a-strokes as a picture (a-light.png), beside
    it or in the folder that --strokes names. The results lie in the same folders as the photos.

    A batch that was stopped goes on when the same command is given again: a journal in the folder of the
    results knows what is done. Photos, strokes or options that have changed are done again. A photo that
    fails does not stop the others; the exit code is then 1.

    \b
    A folder, with a drawing beside each photo:
      dior-rt batch wedding -o wedding-relit
    One drawing for all, into JPEG files, by the fast preset:
      dior-rt batch 'shots/*.jpg' -o relit --strokes window.json --format jpg --preset fast
    A list of names on standard input:
      find . -name '*.tif' -print0 | dior-rt batch - -o relit --strokes strokes/
    On a cluster, whose machines all see the same folders:
      dior-rt batch /photos -o /relit --engine ray --address ray://head:10001
    """
    from dior_rt.batch.find import find_photos, read_names
    from dior_rt.batch.journal import NAME, Journal, read_journal
    from dior_rt.batch.local import LocalEngine
    from dior_rt.batch.plan import hash_settings, make_plan
    from dior_rt.batch.progress import Progress
    from dior_rt.batch.work import Recipe
    from dior_rt.bundle import default_bundle, read_bundle
    from dior_rt.extras import needs_extra
    from dior_rt.files import check_readable, make_folder, remove_drafts
    from dior_rt.images.encoding import Encoding

    names = [name for text in photos for name in _listed(text, read_names)]
    if strokes is not None and not strokes.is_dir():
        check_readable(strokes, "strokes")
    besides = [out] if strokes is None else [out, strokes]
    found = find_photos(names, besides)
    if not found:
        raise InputError(f"There are no photos in {', '.join(photos)}.")
    model = read_bundle(bundle or default_bundle())
    sampling = {
        "preset": preset,
        "steps": steps,
        "solver": solver,
        "shift": shift,
        "guidance": guidance,
        "interval": interval,
        "tolerance": tolerance,
        "seed": seed,
        "intensity": intensity,
        "reach": reach,
    }
    settings = hash_settings(
        model.sha256, {**sampling, "key": key, "quality": quality, "bits": bits, "sidecar": sidecar}
    )

    def plan(records: Any) -> Plan:
        return make_plan(found, strokes, out, format, records, settings, overwrite)

    if engine == "ray":
        with needs_extra("ray", "batch --engine ray"):
            from dior_rt.batch.ray_engine import RayEngine

        run_engine = RayEngine(model.folder, device, ops, address, at_once).run
    elif address:
        raise InputError("--address is of --engine ray.")
    else:
        run_engine = LocalEngine(model, device, ops, at_once, round(in_flight * 1e6)).run
    if dry_run:
        return _show_plan(plan(read_journal(out)), as_json)
    make_folder(out)
    with Journal(out) as journal:
        for folder in {(out / name).parent for name, record in journal.records.items() if not record.is_done}:
            remove_drafts(folder)
        planned = plan(journal.records)
        progress = Progress(len(planned.jobs) + len(planned.refused), len(planned.done), quiet or as_json)
        for refused in planned.refused:
            progress.fail(str(refused.photo), refused.reason)
            journal.failed(refused.name, refused.reason)
        if planned.jobs:
            recipe = Recipe(sampling, key, Encoding(quality, int(bits) if bits else None), sidecar)
            with closing(run_engine(planned.jobs, recipe, journal.begin)) as outcomes:  # type: ignore[type-var]
                for outcome in outcomes:
                    if outcome.error is None:
                        assert outcome.photo and outcome.strokes and outcome.output
                        prints = outcome.photo, outcome.strokes, outcome.output
                        journal.done(outcome.job.name, *prints, settings)
                    else:
                        journal.failed(outcome.job.name, outcome.error)
                    progress.note(outcome)
    progress.finish()
    if as_json:
        say(json.dumps(_report(out, progress, out / NAME), indent=2))
    if progress.failures:
        raise typer.Exit(SOME_FAILED)


def _listed(text: str, read_names: Callable[[bytes], list[str]]) -> list[str]:
    """Return the input, or where it is "-" the names on standard input."""
    if text != "-":
        return [text]
    if sys.stdin.isatty():
        raise InputError("Standard input is a terminal. Pipe a list of photos into the command.")
    return read_names(sys.stdin.buffer.read())


def _show_plan(plan: Plan, as_json: bool) -> None:
    if as_json:
        rows = [
            *({"photo": str(j.photo), "strokes": str(j.strokes), "result": str(j.result)} for j in plan.jobs),
            *({"photo": str(j.photo), "result": str(j.result), "done": True} for j in plan.done),
            *({"photo": str(r.photo), "error": r.reason} for r in plan.refused),
        ]
        say(json.dumps(rows, indent=2))
        return
    for job in plan.jobs:
        say(f"{job.photo} + {job.strokes} -> {job.result}")
    for job in plan.done:
        say(f"{job.photo}: {job.result} is done")
    for refused in plan.refused:
        say(f"{refused.photo}: {refused.reason}")
    counts = f"{len(plan.jobs)} to relight, {len(plan.done)} done, {len(plan.refused)} that cannot be"
    say(f"{counts}. Nothing was written.")


def _report(out: Path, progress: Progress, journal: Path) -> dict[str, Any]:
    return {
        "results": str(out),
        "journal": str(journal),
        "relit": progress.relit,
        "done_before": progress.done,
        "failed": [{"photo": photo, "reason": why} for photo, why in progress.failures],
        "seconds": round(progress.seconds, 3),
    }
