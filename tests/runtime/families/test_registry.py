"""The registry of families: what is built in, and what other packages add by entry points."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dior_rt.bundle import Bundle, read_bundle, write_bundle
from dior_rt.cli import run
from dior_rt.errors import BundleError
from dior_rt.families import BUILT_IN, family_names, open_family
from dior_rt.kernels import Stroke
from dior_rt.relight import Relighter

PACKAGE = '''
from dior_rt.families.mini import Mini

class Inverted(Mini):
    """Mini, whose result is upside down, so that a test can tell it from mini."""

    def __init__(self, bundle, device="auto", threads=None):
        import dataclasses
        manifest = dataclasses.replace(bundle.manifest, family="mini")
        super().__init__(dataclasses.replace(bundle, manifest=manifest), device, threads)

    def decode_relit(self, x0, condition):
        return super().decode_relit(x0, condition)[::-1]
'''
STROKES = [Stroke(((10, 10), (30, 20)), 8.0)]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package as pip leaves it: a module, and its entry points beside it."""
    site = tmp_path / "site"
    info = site / "inverted-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "inverted_family.py").write_text(PACKAGE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: inverted\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[dior_rt.families]\ninverted = inverted_family:Inverted\nbroken = inverted_family:Missing\n"
    )
    monkeypatch.syspath_prepend(str(site))
    yield
    sys.modules.pop("inverted_family", None)


def of_family(bundle: Path, folder: Path, family: str) -> Bundle:
    shipped = read_bundle(bundle)
    files = {name: bundle / name for name in shipped.manifest.files}
    return write_bundle(folder, dataclasses.replace(shipped.manifest, family=family), files)


def test_every_built_in_family_names_a_class_that_is_there() -> None:
    for place in BUILT_IN.values():
        module, _, name = place.partition(":")
        assert isinstance(getattr(__import__(module, fromlist=[name]), name), type)
    assert family_names()[:3] == ("mini", "lumen", "qwen")


def test_an_installed_package_adds_a_family(mini_bundle: Path, tmp_path: Path, installed: None) -> None:
    assert {"inverted", "broken"} <= set(family_names())
    of_family(mini_bundle, tmp_path / "bundle", "inverted")
    photo = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    options = {"steps": 1, "noise_scale": 0.0}
    own, others = (
        np.asarray(Relighter(folder, device="cpu", ops="numpy").relight(photo, STROKES, **options).picture)
        for folder in (mini_bundle, tmp_path / "bundle")
    )
    assert own.shape == others.shape and (own != others).any()


def test_a_family_that_is_not_installed_is_named_in_one_sentence(
    mini_bundle: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bundle = of_family(mini_bundle, tmp_path / "bundle", "maxi")
    with pytest.raises(BundleError, match="family 'maxi', which is not installed; installed families: mini"):
        open_family(bundle, "cpu", None)
    assert run(["info", str(bundle.folder)]) == 0  # what is in it can still be said
    assert "maxi" in capfd.readouterr().out


def test_a_family_whose_package_is_broken_is_named_in_one_sentence(
    mini_bundle: Path, tmp_path: Path, installed: None
) -> None:
    bundle = of_family(mini_bundle, tmp_path / "bundle", "broken")
    with pytest.raises(BundleError, match="'broken' cannot be loaded from inverted_family:Missing"):
        open_family(bundle, "cpu", None)
