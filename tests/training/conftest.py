"""Small renders, made once by the real renderer, for all that learns from renders."""

from functools import partial
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def renders(tmp_path_factory) -> Path:
    """The folder of three scenes, two views each, of 24 x 24 pixels; not to be changed."""
    from dior_rt.training.data import render

    folder = tmp_path_factory.mktemp("renders")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "view", partial(render.view, resolution=24, samples=2))
        render.render_scenes(folder, 3, seed=7)
    return folder


@pytest.fixture(scope="session")
def views(renders):
    from dior_rt.training.data.triplets import load_views

    return load_views(renders)
