"""Formats by the command line: bits, sidecars, and light above white."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dior_rt.cli import run
from dior_rt.images.exr import read_exr, write_exr
from dior_rt.images.photo import read_photo


def test_bits_and_a_sidecar(folder: Path, model: list[str]) -> None:
    assert run(["relight", "photo.png", "strokes.png", "--bits", "16", "--sidecar", *model]) == 0
    relit = read_photo(Path("photo-relit.png"))
    assert relit.bits == 16 and (relit.pixels % 257 != 0).any()
    assert "seed" in Path("photo-relit.xmp").read_text()
    assert run(["relight", "photo.png", "strokes.png", "-o", "a.png", "--quality", "50", *model]) == 2


def test_light_above_white_is_kept_and_relit(folder: Path, model: list[str]) -> None:
    light = np.full((40, 60, 3), 0.2, np.float32)
    light[28:, 45:] = 0.9
    same = light.copy()
    light[32:36, 50:55] = 12.0  # a lamp, far from the strokes
    for name, picture in (("lamp", light), ("none", same)):
        write_exr(Path(f"{name}.exr"), picture)
        assert run(["relight", f"{name}.exr", "strokes.png", *model]) == 0
    lamp, none = (read_exr(Path(f"{name}-relit.exr"), "photo") for name in ("lamp", "none"))
    ratio = lamp[33:35, 51:54] / 12
    around = none[33:35, 51:54] / 0.9
    assert lamp[33:35, 51:54].min() > 2  # still a lamp
    np.testing.assert_allclose(ratio, around, rtol=0.6)  # and relit as what surrounds it
