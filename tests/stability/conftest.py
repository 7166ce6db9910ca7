"""The devices that are here, the shipped model in three precisions, and the ledger of what was seen."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).parent))

import ledger
import precisions
import twin

from dior_rt.bundle import default_bundle, read_bundle, write_bundle
from dior_rt.engine import open_engine
from dior_rt.family.mini import Mini
from dior_rt.grid import GridRule
from dior_rt.kernels import KernelError, NumpyOps, OpenCLOps, list_devices

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


def _devices() -> list:
    try:
        return list_devices()
    except KernelError:
        return []


@pytest.fixture(scope="session", params=["numpy", *_devices()], ids=lambda p: getattr(p, "name", p))
def ops(request: pytest.FixtureRequest):
    return NumpyOps() if request.param == "numpy" else OpenCLOps(request.param)


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The shipped model on a grid of some 16 x 16 cells, by precision."""
    folder = tmp_path_factory.mktemp("precisions")
    shipped = read_bundle(default_bundle())
    grid = dataclasses.replace(GridRule(cells=256), multiple=shipped.manifest.grid.multiple)
    found = {}
    for precision in precisions.PRECISIONS:
        graph = precisions.lower(shipped.path("velocity"), precision, folder / f"{precision}.onnx")
        tensors = dataclasses.replace(shipped.manifest.graphs["velocity"], file="model.onnx", probe=None)
        manifest = dataclasses.replace(
            shipped.manifest, grid=grid, precision=precision, graphs={"velocity": tensors}, noise_scale=1.0
        )
        write_bundle(folder / precision, manifest, {"model.onnx": graph})
        found[precision] = folder / precision
    return found


@pytest.fixture(scope="session")
def network(bundles) -> twin.Network:
    """The shipped model in float64."""
    return twin.Network(read_bundle(bundles["fp32"]).path("velocity"))


@pytest.fixture(scope="session")
def engines(bundles):
    return {p: open_engine(read_bundle(folder), "velocity", "cpu", 1) for p, folder in bundles.items()}


@pytest.fixture(scope="session")
def family(bundles) -> Mini:
    return Mini(read_bundle(bundles["fp32"]), "cpu", 1)
