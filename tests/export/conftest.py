"""A small network with random weights, and its bundle."""

import pytest
import torch

from dior_rt.bundle import Bundle
from dior_rt.export.mini import MiniExportConfig, export_network
from dior_rt.grid import GridRule
from dior_rt.training.network import Config, Mini


def random_mini() -> Mini:
    """Weights that all take part: a new network has silent layers."""
    torch.manual_seed(0)
    network = Mini(Config(width=48, depth=2, heads=4, patch=4, fine=4, half=8, quarter=16))
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if not weight.any() or name.startswith("head"):
                weight.normal_(std=0.2)
    return network.eval()


@pytest.fixture
def network() -> Mini:
    return random_mini()


@pytest.fixture(scope="session")
def recipe() -> MiniExportConfig:
    return MiniExportConfig(name="small", grid=GridRule(1024, 4, 256), steps=4, guidance=2.0)


@pytest.fixture(scope="session")
def exported(tmp_path_factory, recipe) -> Bundle:
    """The bundle of `network`, its weights as float16; not to be changed."""
    return export_network(random_mini(), recipe, tmp_path_factory.mktemp("exported") / "small")
