"""Training learns, and goes on after a stop."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.training.lumen.checkpoint import PART, load_lumen, read_parts, write_parts
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.fit import FitConfig, fit

torch = pytest.importorskip("torch")
TINY = LumenConfig(width=32, heads=1, scene_depth=1, light_depth=1, fine=16, half=16, quarter=16)


def test_training_lowers_the_error(shards: Path, tmp_path: Path) -> None:
    totals: list[float] = []
    config = FitConfig(steps=30, batch=6, rate=3e-3)
    fit(
        shards,
        tmp_path / "run",
        config,
        TINY,
        progress=lambda step, done, errors: totals.append(errors["total"]),
    )
    assert totals[-1] < 0.85 * totals[0]


def test_a_run_goes_on_where_it_stopped(shards: Path, tmp_path: Path) -> None:
    steps: list[int] = []
    out = tmp_path / "run"
    fit(shards, out, FitConfig(steps=3, batch=2), TINY)
    fit(
        shards, out, FitConfig(steps=5, batch=2), TINY, progress=lambda step, done, errors: steps.append(step)
    )
    assert steps == [4, 5]
    assert load_lumen(out).config == TINY


def test_parts_stay_small(tmp_path: Path) -> None:
    tensors = {f"weight{k}": torch.randn(1_000_000) for k in range(9)}
    write_parts(tmp_path, "state", tensors)
    assert len(list(tmp_path.iterdir())) > 1
    assert all(path.stat().st_size <= PART for path in tmp_path.iterdir())
    back = read_parts(tmp_path, "state")
    assert all(torch.equal(back[name], tensor) for name, tensor in tensors.items())
