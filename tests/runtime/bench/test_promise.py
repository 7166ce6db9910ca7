"""What presets promise: the cases, the search, and that the model that ships keeps its word."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dior_rt.bench.cases import made_up
from dior_rt.bench.promise import (
    IDENTICAL,
    MARGIN,
    candidates,
    cost,
    decibels,
    find,
    keep,
    relight,
    settings,
    write_presets,
)
from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.presets import PROMISES, Preset, read_presets
from dior_rt.relight import Relighter

ROOT = Path(__file__).resolve().parents[3]
FEW = 3


@pytest.fixture(scope="module")
def small(mini_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Relighter:
    """The model that ships on a smaller grid, in a folder that may be changed."""
    folder = tmp_path_factory.mktemp("promise") / "small"
    shutil.copytree(mini_bundle, folder)
    return Relighter(folder, device="cpu", ops="numpy")


def test_made_up_cases_differ_and_are_the_same_every_time() -> None:
    cases, again = made_up(12), made_up(12)
    for one, other in zip(cases, again, strict=True):
        np.testing.assert_array_equal(one.photo, other.photo)
        np.testing.assert_array_equal(one.strokes.light, other.strokes.light)
        assert one.photo.shape[:2] == one.strokes.mask.shape
        assert one.photo.std() > 8 and 0.001 < one.strokes.mask.mean() < 0.9
    assert len({case.photo.tobytes() for case in cases}) == len({case.seed for case in cases}) == 12


def test_the_cost_is_the_number_of_branches_run(small: Relighter) -> None:
    bundle = small.bundle  # shift 8, guidance 2
    # Four sigmas: 1, 0.96, 0.889, 0.727.
    assert cost(Preset(4), bundle) == 8
    assert cost(Preset(4, shift=8.0, interval=(0.9, 1.0)), bundle) == 6
    assert cost(Preset(4, interval=(0.0, 0.0)), bundle) == 4
    assert cost(Preset(4, "heun"), bundle) == 14
    assert cost(Preset(4, shift=1.0, interval=(0.4, 0.8)), bundle) == 6  # 1, 0.75, 0.5, 0.25


def test_candidates_come_cheapest_first_and_take_no_more_steps_than_the_model(small: Relighter) -> None:
    tried = candidates(small.bundle)
    costs = [cost(preset, small.bundle) for preset in tried]
    assert costs == sorted(costs) and len(set(tried)) == len(tried)
    assert {preset.steps for preset in tried} == {1, 2, 3, 4}


@pytest.mark.slow
def test_what_is_found_is_the_cheapest_that_keeps_its_promise(small: Relighter, monkeypatch) -> None:
    """Promises that this model can keep on a few steps, held to every cheaper candidate by brute force."""
    promises = {"near": 30.0, "far": 22.0}
    monkeypatch.setattr("dior_rt.bench.promise.PROMISES", promises)
    monkeypatch.setattr("dior_rt.bench.promise.SHIFTS", ())
    monkeypatch.setattr("dior_rt.bench.promise.INTERVALS", ((0.0, 1.0), (0.0, 0.0)))
    cases = made_up(2)
    found = find(small, cases, lambda line: None)
    references = [np.asarray(relight(small, case).picture) for case in cases]

    def worst(preset: Preset) -> float:
        return min(
            decibels(relight(small, case, **settings(preset)), reference)
            for case, reference in zip(cases, references, strict=True)
        )

    for name, promise in promises.items():
        keeps = [p for p in candidates(small.bundle) if worst(p) >= promise + MARGIN]
        assert cost(found[name], small.bundle) == min(cost(p, small.bundle) for p in keeps)
        assert worst(found[name]) >= promise + MARGIN


def test_presets_are_kept_in_the_bundle_and_found_by_name(small: Relighter) -> None:
    presets = {"fast": Preset(2, "adams", 5.0, (0.5, 1.0)), "balanced": Preset(3, "unipc")}
    bundle = write_presets(small.bundle, presets)
    assert read_presets(read_bundle(bundle.folder)) == presets
    relighter = Relighter(bundle.folder, device="cpu", ops="numpy")
    case = made_up(1)[0]
    by_name, by_hand = (
        relight(relighter, case, **how) for how in ({"preset": "fast"}, settings(presets["fast"]))
    )
    np.testing.assert_array_equal(by_name.picture, by_hand.picture)
    assert (by_name.sampling.preset, by_name.steps) == ("fast", 2)


def test_the_reference_keeps_everything(small: Relighter) -> None:
    kept = keep(small, made_up(2), {"same": {}, "less": {"steps": 2}})
    assert kept["same"].worst == kept["same"].median == IDENTICAL
    assert kept["less"].worst <= kept["less"].median < IDENTICAL
    assert kept["same"].steps == (4, 4) and kept["less"].steps == (2, 2)
    assert kept["less"].steps_speed > 1


def promises_broken(cases) -> dict[str, float]:
    relighter = Relighter(device="cpu")
    presets = read_presets(relighter.bundle)
    assert presets.keys() == PROMISES.keys()
    kept = keep(relighter, cases, {name: settings(preset) for name, preset in presets.items()})
    return {name: one.worst for name, one in kept.items() if one.worst < PROMISES[name]}


@pytest.mark.slow
def test_the_model_that_ships_keeps_its_promises() -> None:
    assert promises_broken(made_up(FEW)) == {}


@pytest.mark.slow
def test_it_keeps_them_in_the_worst_of_50_cases() -> None:
    assert promises_broken(made_up(50)) == {}


@pytest.mark.slow
def test_it_keeps_them_on_renders_that_training_has_not_seen(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    from dior_rt.training.data.bench_cases import from_renders
    from dior_rt.training.data.render import render_scenes

    render_scenes(tmp_path, 25, 900)  # a set of scenes of its own
    assert promises_broken(from_renders(tmp_path, 50)) == {}


def test_presets_are_slower_than_the_reference_in_no_shipped_model() -> None:
    bundle = read_bundle(default_bundle())
    presets, own = read_presets(bundle), cost(Preset(bundle.manifest.steps), bundle)
    costs = [cost(presets[name], bundle) for name in ("fast", "balanced")]
    assert costs == sorted(costs) and costs[-1] <= own


def test_a_bundle_that_is_not_there_is_no_broken_promise(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.presets", tmp_path / "none"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert said.returncode == 2 and said.stderr == f"dior-rt: There is no bundle at {tmp_path / 'none'}.\n"
