"""What several parts are tested with: the model that ships, on a smaller grid and with few steps."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from dior_rt.bundle import default_bundle, read_bundle, write_bundle
from dior_rt.grid import GridRule


@pytest.fixture(scope="session")
def mini_bundle(tmp_path_factory) -> Path:
    """The folder of a quick bundle with the weights that ship; not to be changed."""
    folder = tmp_path_factory.mktemp("bundles")
    shutil.copytree(default_bundle(), folder / "shipped")
    shipped = read_bundle(folder / "shipped").manifest
    grid = dataclasses.replace(GridRule(cells=1024), multiple=shipped.grid.multiple)
    quick = dataclasses.replace(shipped, name="small", grid=grid, steps=4, guidance=2.0, noise_scale=1.0)
    write_bundle(folder / "small", quick, {name: folder / "shipped" / name for name in shipped.files})
    return folder / "small"
