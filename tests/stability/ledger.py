"""Collect every error that a test compares with a bound, and write the page of them.

    pytest tests/stability -m "slow or not slow" --numerics docs/numerics.md

A test calls `hold(case, where, got, want, bound)`: the result must be finite, and its largest difference to
the float64 reference, divided by `scale`, at most the bound.
"""

from __future__ import annotations

import inspect
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt
import onnxruntime

from dior_rt.kernels import KernelError, list_devices

COMMAND = 'pytest tests/stability -m "slow or not slow" --numerics docs/numerics.md'


@dataclass(frozen=True)
class Entry:
    """The worst error of a case in one setting.

    where: the device, the network's precision, or the solver. shown: the text in the table.
    """

    case: str
    where: str
    unit: str
    bound: float
    seen: float
    shown: str


@dataclass
class Ledger:
    """The worst entry of each case and setting, by area. An area is a test module."""

    areas: dict[str, dict[tuple[str, str], Entry]] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)

    def note(self, module: ModuleType, entry: Entry) -> None:
        text = inspect.getdoc(module) or ""
        self.texts[module.__name__] = text
        area = self.areas.setdefault(module.__name__, {})
        old = area.get((entry.case, entry.where))
        if old is None or not entry.seen <= old.seen:
            area[entry.case, entry.where] = entry

    def page(self, old: str = "") -> str:
        """Return the page in Markdown. Sections of areas that did not run are kept from the old page."""
        parts = dict(part.split("\n", 1) for part in old.split("\n## ")[1:])
        for name, area in self.areas.items():
            title, _, text = self.texts[name].partition("\n")
            parts[title.rstrip(".")] = f"\n{text.strip()}\n\n{_table([*area.values()])}\n"
        sections = (f"## {title}\n{parts[title].rstrip()}\n" for title in sorted(parts))
        return "\n".join([HEAD.format(command=COMMAND, machine=_machine()), *sections])


HEAD = """# Numbers on hard cases

After reading this page you know how large the numerical errors are in extreme cases. In every case of
`tests/stability`, the result is finite and in range, and its error against a float64 reference of the same
computation is within the bound. A cell shows the largest error, then the bound in brackets. `exact` means
that no difference is allowed, and none occurred. This page is written by

    {command}

on {machine}.
"""


def holder(ledger: Ledger, module: ModuleType) -> Callable[..., None]:
    """Return `hold` for the tests of one module."""

    def hold(
        case: str,
        where: str,
        got: npt.ArrayLike,
        want: npt.ArrayLike,
        bound: float,
        unit: str = "",
        scale: npt.ArrayLike = 1.0,
        shown: str = "",
    ) -> None:
        """Check that the result is finite and within bound * scale of `want`, and note the error."""
        got, want = np.asarray(got), np.asarray(want)
        assert got.shape == want.shape, f"{case}: {got.shape} where {want.shape} is expected"
        assert np.isfinite(got).all(), f"{case}, {where}: the result is not finite"
        apart = np.abs(got.astype(np.float64) - want.astype(np.float64)) / scale
        seen = float(apart.max(initial=0))
        usual = "exact" if bound == 0 else f"{seen:.2f}" if bound >= 0.1 else f"{seen:.1e}"
        ledger.note(module, Entry(case, where, unit, bound, seen, shown or usual))
        assert seen <= bound, f"{case}, {where}: off by {seen:.3g} {unit}; {bound:g} is allowed"

    return hold


def _table(entries: list[Entry]) -> str:
    columns = list(dict.fromkeys(entry.where for entry in entries))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for entry in entries:
        cell = f"{entry.shown} ({entry.bound:g})" if entry.bound else entry.shown
        rows.setdefault((entry.case, entry.unit), {})[entry.where] = cell
    lines = ["| case | error in | " + " | ".join(columns) + " |", "|---" * (2 + len(columns)) + "|"]
    for (case, unit), cells in rows.items():
        lines.append(f"| {case} | {unit} | " + " | ".join(cells.get(c, "") for c in columns) + " |")
    return "\n".join(lines)


def _machine() -> str:
    try:
        devices = [f"opencl:{device.index} = {device.name}, {device.platform}" for device in list_devices()]
    except KernelError:
        devices = []
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    return "; ".join(
        [f"{platform.machine()} with {versions}, ONNX Runtime {onnxruntime.__version__}", *devices]
    )


def write(ledger: Ledger, path: Path) -> None:
    """Write the page. If it exists, replace only the sections that ran."""
    old = path.read_text("utf-8") if path.exists() else ""
    path.write_text(ledger.page(old), encoding="utf-8")
