"""Hold a bundle's presets to what they promise, or find them anew:

python -m tools.presets --renders held-out            # worst and median of 50 cases, and the speed
python -m tools.presets --renders held-out --find     # the cheapest that keep it, put into the bundle
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dior_rt.bench.cases import Case, made_up
from dior_rt.bench.promise import Kept, find, keep, settings, write_presets
from dior_rt.bench.tables import table
from dior_rt.errors import InputError
from dior_rt.extras import needs_extra
from dior_rt.presets import PROMISES, read_presets
from dior_rt.relight import Relighter
from tools.command import start

TOLERANCES = (0.5, 1.0, 2.0, 4.0)  # of 255


def main(
    bundle: Annotated[Path | None, typer.Argument(help="[default: the one that ships]")] = None,
    renders: Annotated[
        Path | None, typer.Option(help="Held-out renders, beside scenes made by arithmetic.")
    ] = None,
    cases: Annotated[int, typer.Option(min=1, help="Of either kind.")] = 50,
    search: Annotated[
        bool, typer.Option("--find", help="Search, and put what is found into BUNDLE.")
    ] = False,
    threads: Annotated[int | None, typer.Option(min=1, help="Of the network.")] = None,
) -> None:
    """Measure the presets of BUNDLE against the reference; exits with 1 where a promise is broken."""
    relighter = Relighter(bundle, device="cpu", threads=threads)
    if relighter.bundle.manifest.grid is None:
        raise InputError("Presets are measured of models that predict light on a grid.")
    chosen = _cases(renders, cases)
    if search:
        presets = find(relighter, chosen, lambda line: typer.echo(line, err=True))
        write_presets(relighter.bundle, presets)
    else:
        presets = read_presets(relighter.bundle)
    ways = {name: settings(preset) for name, preset in presets.items()}
    ways |= {f"tolerance {level:g}/255": {"tolerance": level / 255} for level in TOLERANCES}
    with typer.progressbar(length=len(chosen), label="cases") as bar:
        kept = keep(relighter, chosen, ways, lambda: bar.update(1))
    typer.echo(as_markdown(kept, ways))
    broken = [name for name in presets if kept[name].worst < PROMISES.get(name, 0)]
    if broken:
        typer.echo(f"broken: {', '.join(broken)}", err=True)
        raise typer.Exit(1)


def as_markdown(kept: dict[str, Kept], ways: dict[str, dict[str, Any]]) -> str:
    """A row for every way."""
    heads = [
        "preset", "settings", "steps", "worst, dB", "median, dB", "steps: times as fast", "all: times as fast"
    ]  # fmt: skip
    rows = [
        [
            name,
            ", ".join(
                f"{key} {value}"
                for key, value in ways[name].items()
                if key in ("solver", "shift", "interval")
            ),
            "-".join(map(str, sorted(set(one.steps)))),
            f"{one.worst:.1f}",
            f"{one.median:.1f}",
            f"{one.steps_speed:.2f}",
            f"{one.speed:.2f}",
        ]
        for name, one in kept.items()
    ]
    return table(heads, rows)


def _cases(renders: Path | None, count: int) -> list[Case]:
    cases = made_up(count)
    if renders is not None:
        with needs_extra("train"):
            from dior_rt.training.data.bench_cases import from_renders

            cases += from_renders(renders, count)
    return cases


if __name__ == "__main__":
    start(main)
