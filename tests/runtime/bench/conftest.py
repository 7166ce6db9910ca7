"""One benchmark of the small bundle, run as a person would, that several tests look at."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from dior_rt.bench.report import Report, read_report


@dataclass(frozen=True)
class Run:
    """A benchmark that ran: where its files are, what it printed."""

    folder: Path
    said: subprocess.CompletedProcess

    @property
    def report(self) -> Report:
        return read_report(self.folder / "bench.json")


def run_bench(*arguments: object, timeout: float = 300) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "dior_rt", "bench", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout,
    )


@pytest.fixture
def bench() -> Callable[..., subprocess.CompletedProcess]:
    """`dior-rt bench` as a process of its own."""
    return run_bench


@pytest.fixture(scope="session")
def quick(mini_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("bench")
    options = ["--quick", "--bundle", mini_bundle, "--ops", "numpy", "--device", "cpu", "--megapixels", 0.02]
    files = ["--json", folder / "bench.json", "--plot", folder / "bench.png"]
    return Run(folder, run_bench(*options, "--steps", 1, "--steps", 2, "--steps", 4, *files))
