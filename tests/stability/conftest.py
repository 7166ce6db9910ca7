"""The shipped model in three precisions, its float64 twin, and the ledger of what was seen."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).parent))

import ledger
import precisions
import twin

from dior_rt import Relighter
from dior_rt.bundle import Bundle, default_bundle, read_bundle, write_bundle
from dior_rt.family.mini import Mini
from dior_rt.grid import GridRule

NOTES = pytest.StashKey[ledger.Ledger]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--numerics", metavar="PATH", help="write the errors that tests/stability saw")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[NOTES] = ledger.Ledger()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    path = session.config.getoption("--numerics", None)
    if path and exitstatus == 0:
        ledger.write(session.config.stash[NOTES], Path(path))


@pytest.fixture
def hold(request: pytest.FixtureRequest) -> Callable[..., None]:
    """`hold(case, where, got, want, bound, unit, scale)`; see ledger.py."""
    return ledger.holder(request.config.stash[NOTES], request.module)


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Bundle]:
    """`bundle(precision)`: the shipped model on a grid of some 256 cells."""
    folder, shipped = tmp_path_factory.mktemp("precisions"), read_bundle(default_bundle())
    grid = dataclasses.replace(GridRule(cells=256), multiple=shipped.manifest.grid.multiple)

    @cache
    def lowered(precision: str) -> Bundle:
        graph = precisions.lower(shipped.path("velocity"), precision, folder / f"{precision}.onnx")
        tensors = dataclasses.replace(shipped.manifest.graphs["velocity"], file="model.onnx", probe=None)
        changes = {"grid": grid, "precision": precision, "graphs": {"velocity": tensors}, "noise_scale": 1.0}
        manifest = dataclasses.replace(shipped.manifest, **changes)
        return write_bundle(folder / precision, manifest, {"model.onnx": graph})

    return lowered


@pytest.fixture(scope="session")
def relighter(bundle) -> Callable[[str, str], Relighter]:
    """`relighter(precision, ops)`, loaded once; the network runs on one thread of the CPU."""
    return cache(lambda precision, ops: Relighter(bundle(precision).folder, "cpu", ops, threads=1))


@pytest.fixture(scope="session")
def family(bundle) -> Mini:
    return Mini(bundle("fp32"), "cpu", 1)


@pytest.fixture(scope="session")
def network(bundle) -> twin.Network:
    """The shipped model in float64."""
    return twin.Network(bundle("fp32").path("velocity"))


@pytest.fixture(scope="session")
def usual_feeds() -> dict[str, np.ndarray]:
    """Inputs of the shipped graph, of both modes and several sigmas: the bundle's own self-test."""
    shipped = read_bundle(default_bundle())
    graph = shipped.manifest.graphs["velocity"]
    with np.load(shipped.folder / graph.probe) as probe:
        return {tensor.name: probe[tensor.name] for tensor in graph.inputs}
