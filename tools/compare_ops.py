"""Measure NumPy's pixel kernels beside OpenCL's: a process's first photo, cold and warm, and the next.

    python -m tools.compare_ops --ops numpy --ops opencl:0

Cold: nothing is compiled yet. Warm: an earlier process has compiled. Next: a further photo of the same
process. Every figure is a photo's reduction and transfer: seconds of the clock and, in brackets, of the
processor.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from typing import Annotated

import typer

_CODE = """
import json, sys, time
begun = time.perf_counter(), time.process_time()
import numpy as np
from dior_rt.kernels import open_ops
imported = time.perf_counter(), time.process_time()
height, width = json.loads(sys.argv[2])
rng = np.random.default_rng(0)
photo = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
source, relit = rng.random((2, 52, 78, 3), np.float32)
found = []
ops = None
for _ in range(3):
    start = time.perf_counter(), time.process_time()
    ops = ops or open_ops(sys.argv[1])
    ops.reduce_photo(photo, (52, 78))
    ops.transfer(photo, source, relit)
    found.append((time.perf_counter() - start[0], time.process_time() - start[1]))
print(json.dumps([found[0], min(found[1:])]))
"""


def main(
    ops: Annotated[list[str], typer.Option(help="What to measure; may be repeated.")],
    megapixels: Annotated[list[float] | None, typer.Option(help="Sizes; may be repeated.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each, by turns; medians are shown.")] = 3,
) -> None:
    """Print a table in Markdown."""
    typer.echo("| megapixels | kernels | cold | warm | next |\n|---|---|---|---|---|")
    for size in megapixels or [1.0, 12.0, 50.0]:
        height = round((size * 1e6 / 1.5) ** 0.5)
        found: dict[str, list[list[list[float]]]] = {name: [] for name in ops}
        for _ in range(repeats):
            for name in ops:
                with tempfile.TemporaryDirectory() as cache:
                    environment = {**os.environ, "XDG_CACHE_HOME": cache}
                    environment.pop("POCL_CACHE_DIR", None)
                    runs = [_run(name, height, round(height * 1.5), environment) for _ in range(2)]
                found[name].append([runs[0][0], runs[1][0], runs[1][1]])
        for name in ops:
            cells = [
                f"{statistics.median(run[k][0] for run in found[name]):.2f} "
                f"({statistics.median(run[k][1] for run in found[name]):.2f})"
                for k in range(3)
            ]
            typer.echo(f"| {size:g} | {name} | {' | '.join(cells)} |")


def _run(name: str, height: int, width: int, environment: dict[str, str]) -> list[list[float]]:
    command = [sys.executable, "-c", _CODE, name, json.dumps([height, width])]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


if __name__ == "__main__":
    typer.run(main)
