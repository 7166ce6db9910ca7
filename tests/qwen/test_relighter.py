"""A qwen bundle behind the same door as every other."""

from __future__ import annotations

import numpy as np
import tiny_qwen

from dior_rt import Relighter


def test_the_relighter_runs_a_qwen_bundle(make):
    relighter = Relighter(make(steps=2, free_steps=False), device="cpu", ops="numpy")
    photo = np.asarray(tiny_qwen.picture(203, 131))
    strokes = np.zeros((131, 203, 4), np.float32)
    strokes[20:40, 30:60] = (2.0, 1.0, 0.5, 1.0)
    seen = []
    relit = relighter.relight(photo, strokes, progress=lambda step, steps: seen.append((step, steps)))
    assert relit.picture.shape == photo.shape and relit.picture.dtype == np.uint8
    assert seen == [(1, 2), (2, 2)]
    again = relighter.relight(photo, strokes)
    np.testing.assert_array_equal(relit.picture, again.picture)
    lumi = relighter.estimate(photo)
    assert lumi.ndim == 3 and (lumi >= 0).all() and np.isfinite(lumi).all()
