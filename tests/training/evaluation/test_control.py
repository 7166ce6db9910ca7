"""What is said of relighters whose answer to the brush is known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from dior_rt.grid import GridRule
from dior_rt.kernels import NumpyOps
from dior_rt.training.evaluation.baselines import quotient
from dior_rt.training.evaluation.benchmarks import renders as benchmarks
from dior_rt.training.evaluation.control import borders, chroma, keep_psnr, progress, response

OPS = NumpyOps()


def tasks(folder, kind, seed=3):
    return list(benchmarks(folder, (kind,), seed)[0])


def copying(photo, strokes):
    return photo


def painting(photo, strokes):
    """Puts a twentieth of the strokes' own light on the picture."""
    painted = OPS.encode_srgb(strokes.light * np.float32(0.05), np.uint8)
    return np.where(strokes.mask[..., None] > 0, painted, photo)


def shining(photo, strokes):
    """Adds a fifth of the strokes' light to the picture."""
    return OPS.encode_srgb(OPS.decode_srgb(photo) + strokes.light * np.float32(0.2), np.uint8)


def dimming(photo, strokes):
    """Halves the light of the whole picture, whatever is drawn."""
    return OPS.encode_srgb(OPS.decode_srgb(photo) * np.float32(0.5), np.uint8)


def test_light_in_proportion_has_slope_one_and_a_copy_slope_zero(renders) -> None:
    still = tasks(renders, "keep")
    painted = response(painting, still)
    assert painted.slope == pytest.approx(1, abs=0.1) and painted.monotonic == 1
    assert painted.leakage == 0 and painted.dabs == len(still)
    copied = response(copying, still)
    assert copied.slope == pytest.approx(0, abs=1e-9) and copied.monotonic == 0 == copied.leakage


def test_what_changes_everywhere_leaks(renders) -> None:
    assert response(dimming, tasks(renders, "keep")).leakage > 0.3


def test_light_added_in_the_dab_s_colour_has_its_hue(renders) -> None:
    still = tasks(renders, "keep")
    assert chroma(shining, still).hue < 10
    assert chroma(copying, still).hue == 90


def test_the_true_quotient_has_the_right_chromaticity(renders) -> None:
    """photo * drawn light / true light is what the surface shows under the drawn light."""
    still = tasks(renders, "keep")
    known = {task.source.tobytes(): task for task in still}

    def dividing(photo, strokes):
        source = known[photo.tobytes()].source_lumi
        drawn = strokes.mask[..., None] > 0
        return quotient(photo, source, np.where(drawn, 0.5 * strokes.light, source))

    exact, copied = chroma(dividing, still), chroma(copying, still)
    assert exact.chromaticity < 8 < 20 < copied.chromaticity


def test_further_strokes_help_who_heeds_them(renders) -> None:
    changed = tasks(renders, "change", 1) + tasks(renders, "replace", 1)
    truths = {task.source.tobytes(): task.truth for task in changed}

    def heeding(photo, strokes):
        return np.where(strokes.mask[..., None] > 0, truths[photo.tobytes()], photo)

    def spoiling(photo, strokes):
        return np.where(strokes.mask[..., None] > 0, 255 - truths[photo.tobytes()], truths[photo.tobytes()])

    helped, spoiled = progress(heeding, changed), progress(spoiling, changed)
    assert helped.not_worse == 1 and helped.gain > 0
    assert spoiled.gain < 0 and spoiled.not_worse < 1
    assert progress(copying, changed).gain == 0


def test_one_stroke_alone_has_no_progress(renders) -> None:
    task = tasks(renders, "change", 1)[0]
    mask = np.zeros(task.source.shape[:2], np.float32)
    mask[2:5, 2:5] = 1
    assert progress(copying, [replace(task, mask=mask)]) is None


@pytest.mark.parametrize("kind", ["keep", "add"])
def test_keeping_is_judged_where_no_stroke_speaks_and_no_light_changed(kind, renders) -> None:
    found = tasks(renders, kind)
    assert keep_psnr(copying, found) == pytest.approx(100)
    truths = {task.source.tobytes(): task.truth for task in found}

    def spoiling(photo, strokes):
        """Wrong under strokes, right where the truth changed."""
        drawn = strokes.mask[..., None] > 0
        return np.where(drawn, 255 - photo, truths[photo.tobytes()])

    assert keep_psnr(spoiling, found) > 42  # what is the same may still differ by two codes
    assert keep_psnr(lambda photo, strokes: 255 - photo, found) < 30


def test_an_added_light_only_adds(renders) -> None:
    for task in tasks(renders, "add"):
        assert (task.target_lumi >= task.source_lumi - 1e-3).all()
        assert task.target_lumi.mean() > task.source_lumi.mean()


def test_borders_show_a_method_of_blocks() -> None:
    photos = list(np.random.default_rng(0).integers(60, 190, (3, 64, 64, 3), dtype=np.uint8))
    rule = GridRule(cells=1024, multiple=8)

    def flat(photo):
        return np.ones((32, 32, 3), np.float32) * np.linspace(1, 2, 32, dtype=np.float32)[:, None, None]

    def blocky(photo):
        rows, columns = np.indices((32, 32)) // 8
        return flat(photo) + ((rows + columns) % 2)[..., None].astype(np.float32)

    def relight_smooth(photo, strokes):
        return OPS.encode_srgb(OPS.decode_srgb(photo) * flat(photo) * np.float32(0.4), np.float32)

    def relight_blocky(photo, strokes):
        return OPS.encode_srgb(OPS.decode_srgb(photo) * blocky(photo) * np.float32(0.3), np.float32)

    smooth = borders(relight_smooth, flat, rule, photos)
    assert smooth.photos == 3 and smooth.estimated == pytest.approx(1, abs=0.1)
    assert smooth.relit == pytest.approx(1, abs=0.15)
    blocks = borders(relight_blocky, blocky, rule, photos)
    assert blocks.estimated > 5 and blocks.relit > 5
