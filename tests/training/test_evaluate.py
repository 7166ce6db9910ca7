"""The evaluation: relighters whose figures are known beforehand, and a bundle from end to end."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from dior_rt.kernels import NumpyOps
from dior_rt.relight import Relighter
from dior_rt.training.evaluate import (
    HUES,
    Settings,
    accuracy,
    evaluate,
    hue_angle,
    hue_error,
    keep_psnr,
    markdown,
    prepare,
    response,
    score,
)
from dior_rt.training.triplets import pair

OPS = NumpyOps()


def copying(photo, strokes):
    return photo


def painting(photo, strokes):
    """Puts a twentieth of the strokes' own light on the picture."""
    painted = OPS.encode_srgb(strokes.light * np.float32(0.05), np.uint8)
    return np.where(strokes.mask[..., None] > 0, painted, photo)


def shining(photo, strokes):
    """Adds a fifth of the strokes' light to the picture."""
    return OPS.encode_srgb(OPS.decode_srgb(photo) + strokes.light * np.float32(0.2), np.uint8)


def test_a_copy_scores_as_the_copy(views) -> None:
    row = accuracy(copying, views, "change", "strokes")
    assert row.relit == row.copy and row.pictures == len(views) and 5 < row.copy.psnr < 100


def test_the_truth_scores_best(views) -> None:
    truths = iter(
        [pair(np.random.default_rng([k, 1]), view, "replace").relit for k, view in enumerate(views)]
    )
    row = accuracy(lambda photo, strokes: OPS.encode_srgb(next(truths), np.uint8), views, "replace", "dense")
    assert row.relit.rmse == 0 and row.relit.psnr == pytest.approx(100) and row.relit.ssim == pytest.approx(1)
    assert row.copy.psnr < row.relit.psnr


def test_scores_agree_with_scikit_image() -> None:
    rng = np.random.default_rng(0)
    pictures, truths = rng.integers(0, 256, (2, 3, 16, 16, 3), dtype=np.uint8)
    got = score(list(pictures), list(truths))
    expected = [peak_signal_noise_ratio(a, b) for a, b in zip(truths, pictures, strict=True)]
    assert got.psnr == pytest.approx(np.mean(expected))
    difference = pictures.astype(float) - truths
    assert got.rmse == pytest.approx(np.sqrt((difference**2).mean()))


def test_light_in_proportion_has_slope_one_and_a_copy_slope_zero(views) -> None:
    assert response(painting, views).slope == pytest.approx(1, abs=0.1)
    assert response(painting, views).monotonic == 1
    still = response(copying, views)
    assert still.slope == pytest.approx(0, abs=1e-9) and still.monotonic == 0 and still.dabs == len(views)


def test_light_added_in_the_dab_s_colour_has_its_hue(views) -> None:
    assert hue_error(shining, views) < 10
    assert hue_error(copying, views) == 90


def test_hue_angles() -> None:
    red, green, blue = np.eye(3)
    assert hue_angle(red, 5 * red + 1) == pytest.approx(0, abs=1e-4)
    assert hue_angle(red, green) == pytest.approx(120) and hue_angle(blue, -blue) == pytest.approx(180)
    assert hue_angle(red, np.ones(3)) == pytest.approx(90)
    assert all(hue_angle(np.array(hue), np.array(hue)) < 1e-3 for hue in HUES)


def test_keeping_is_judged_where_no_stroke_speaks(views) -> None:
    assert keep_psnr(copying, views) == pytest.approx(100)

    def spoiling(photo, strokes):
        return np.where(strokes.mask[..., None] > 0, 255 - photo, photo)

    assert keep_psnr(spoiling, views) == pytest.approx(100)
    assert keep_psnr(lambda photo, strokes: 255 - photo, views) < 30


def test_a_bundle_is_evaluated_with_the_settings_asked_for(mini_bundle, views) -> None:
    relighter = Relighter(mini_bundle, ops="numpy")
    manifest = relighter.bundle.manifest
    own, relight = prepare(relighter, Settings())
    assert own == Settings(manifest.steps, manifest.guidance, manifest.noise_scale)
    evaluation = evaluate(relighter, views[:2], Settings(steps=1, noise_scale=0.0), dabs=1)
    assert evaluation.settings == Settings(1, manifest.guidance, 0.0)
    assert relighter.bundle.manifest == manifest
    assert [(row.kind, row.drawn) for row in evaluation.accuracy] == [
        ("replace", "dense"),
        ("replace", "strokes"),
        ("change", "dense"),
        ("change", "strokes"),
    ]
    again = evaluate(relighter, views[:2], Settings(steps=1, noise_scale=0.0), dabs=1)
    assert again.response == evaluation.response and again.keep_psnr == evaluation.keep_psnr
    table = markdown(evaluation)
    assert table.startswith("1 steps") and table.count("\n| ") == 5
    photo = np.full((24, 24, 3), 90, np.uint8)
    strokes = OPS.sparsify(np.ones((24, 24, 3), np.float32), "dense", 0)
    quiet = prepare(relighter, Settings(noise_scale=0.0))[1]
    assert not np.array_equal(relight(photo, strokes), quiet(photo, strokes))
