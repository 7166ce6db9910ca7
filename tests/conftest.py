"""What several parts are tested with: a small mini with random weights, and its bundle."""

from pathlib import Path

import pytest


def random_mini(seed: int = 0):
    """Mini's network, small, with weights that all take part; a new one has silent layers."""
    import torch

    from dior_rt.training.network import Config, Mini

    torch.manual_seed(seed)
    network = Mini(Config(width=48, depth=2, heads=4, patch=4, features=8))
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if not weight.any() or name.startswith("head"):
                weight.normal_(std=0.2)
    return network.eval()


@pytest.fixture
def network():
    return random_mini()


@pytest.fixture(scope="session")
def recipe():
    from dior_rt.export.mini import Recipe
    from dior_rt.grid import GridRule

    return Recipe(name="small", grid=GridRule(1024, 4, 256), steps=4, guidance=2.0)


@pytest.fixture(scope="session")
def mini_bundle(tmp_path_factory, recipe) -> Path:
    """The folder of a small mini's bundle; not to be changed."""
    from dior_rt.export.mini import export_network

    folder = tmp_path_factory.mktemp("bundles") / "small"
    export_network(random_mini(), recipe, folder)
    return folder
