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
from dior_rt.engine import Engine
from dior_rt.export.check import run
from dior_rt.families.mini import SEEN, Graphs, Mini
from dior_rt.grid import GridRule

INPUTS = ("x", "sigma", "mode", *SEEN)
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
        files, graphs = {}, {}
        for name, graph in shipped.manifest.graphs.items():
            lower = folder / f"{name}-{precision}.onnx"
            files[graph.file] = precisions.lower(shipped.path(name), precision, lower)
            graphs[name] = dataclasses.replace(graph, probe=None)
        changes = {"grid": grid, "precision": precision, "graphs": graphs, "noise_scale": 1.0}
        manifest = dataclasses.replace(shipped.manifest, **changes)
        return write_bundle(folder / precision, manifest, files)

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
    return twin.Network(bundle("fp32"))


@pytest.fixture(scope="session")
def velocity(bundle) -> Callable[..., np.ndarray]:
    """`velocity(feeds, precision, threads)`: one evaluation of the shipped network."""

    @cache
    def graphs(precision: str, threads: int) -> Graphs:
        paths = (bundle(precision).path(name) for name in ("encode", "velocity"))
        return Graphs(*(Engine(path, threads=threads) for path in paths))

    return lambda feeds, precision, threads=1: run(graphs(precision, threads), feeds)


@pytest.fixture(scope="session")
def usual_feeds() -> dict[str, np.ndarray]:
    """Inputs of an evaluation, of both modes and several sigmas: the bundle's own self-test."""
    shipped, feeds = read_bundle(default_bundle()), {}
    for graph in shipped.manifest.graphs.values():
        with np.load(shipped.folder / graph.probe) as probe:
            feeds |= {name: probe[name] for name in INPUTS if name in probe}
    return feeds
