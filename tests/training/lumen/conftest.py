"""Small synthetic views and a tiny network that the tests of this folder share."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from dior_rt.training.lumen.config import LumenConfig  # noqa: E402
from dior_rt.training.lumen.model import Lumen  # noqa: E402
from dior_rt.training.lumen.pack import load_shards, write_shards  # noqa: E402
from dior_rt.training.lumen.views import Views  # noqa: E402
from tests.training.lumen.balls import ball  # noqa: E402


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    write_shards((ball(seed) for seed in range(4)), folder)
    return folder


@pytest.fixture(scope="session")
def views(shards: Path) -> Views:
    return load_shards(shards)


@pytest.fixture(scope="session")
def network() -> Lumen:
    """A tiny network whose heads are loud enough that every path matters."""
    torch.manual_seed(0)
    found = Lumen(
        LumenConfig(width=32, heads=1, scene_depth=1, light_depth=1, fine=16, half=16, quarter=16)
    ).eval()
    for head in (found.scene.light, found.light.head):
        torch.nn.init.normal_(head.weight, std=0.05)
    return found
