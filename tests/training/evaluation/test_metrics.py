"""Every measure on arrays whose figure is known beforehand, or that another library measures as well."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from dior_rt.training.evaluation.metrics import (
    angle,
    border_ratio,
    decibels,
    hue_angle,
    interval,
    leakage,
    log_slope,
    psnr,
    rising,
    rmse,
    scaled_psnr,
    speckle,
    ssim,
    steps_not_worse,
)

rng = np.random.default_rng(0)
NOISE, OTHER = rng.integers(0, 256, (2, 24, 16, 3), dtype=np.uint8)


def test_errors_of_known_size() -> None:
    grey = np.full((8, 8, 3), 100, np.uint8)
    assert rmse(grey, grey) == 0 and psnr(grey, grey) == pytest.approx(100)
    assert rmse(grey, grey + np.uint8(7)) == pytest.approx(7) == rmse(grey + np.uint8(7), grey)
    assert rmse(np.zeros_like(grey), np.full_like(grey, 255)) == 255  # no 8-bit overflow
    assert psnr(np.zeros_like(grey), np.full_like(grey, 255)) == pytest.approx(0)
    assert decibels(0.01, peak=1) == pytest.approx(20)


def test_psnr_and_ssim_agree_with_scikit_image() -> None:
    assert psnr(NOISE, OTHER) == pytest.approx(peak_signal_noise_ratio(OTHER, NOISE))
    assert ssim(NOISE, OTHER) == pytest.approx(structural_similarity(NOISE, OTHER, channel_axis=2))
    assert ssim(NOISE, NOISE) == pytest.approx(1)


def test_speckle_is_what_a_median_takes_away() -> None:
    grey = np.full((20, 30, 3), 100, np.uint8)
    assert speckle(grey) == 0
    grey[:, 15:] = 200
    assert speckle(grey) == 0  # edges stay
    salt = np.full((20, 30, 3), 100, np.uint8)
    salt[1::4, 1::4] = 250
    assert speckle(salt) == pytest.approx(150 * 5 * 8 / 600)


def test_the_interval_is_that_of_the_mean() -> None:
    values = list(np.random.default_rng(1).normal(10, 2, 400))
    low, high = interval(values)
    # The central limit theorem's: the mean +- 1.96 standard errors.
    error = np.std(values) / 20
    assert low == pytest.approx(np.mean(values) - 1.96 * error, abs=0.2 * error)
    assert high == pytest.approx(np.mean(values) + 1.96 * error, abs=0.2 * error)
    assert interval(values) == (low, high)
    assert interval([3.0]) == (3.0, 3.0)
    narrow = interval(values, level=0.5)
    assert low < narrow[0] < narrow[1] < high


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    draws = np.random.default_rng(2).exponential(1, (100, 60))
    inside = [low <= 1 <= high for low, high in map(interval, draws)]
    assert 0.86 <= np.mean(inside) <= 1


def test_slopes_of_powers() -> None:
    strengths = (0.25, 1.0, 4.0)
    for power in (0.0, 0.5, 1.0, 2.0):
        assert log_slope(strengths, [3 * s**power for s in strengths]) == pytest.approx(power, abs=1e-9)
    assert np.isfinite(log_slope(strengths, [0, 0, 0]))


def test_rising_is_strict() -> None:
    assert rising([1, 2, 3]) and not rising([1, 2, 2]) and not rising([2, 1, 3])


def test_angles() -> None:
    red, green, _ = np.eye(3)
    assert angle(red, 5 * red) == pytest.approx(0, abs=1e-4)
    assert angle(red, green) == pytest.approx(90) and angle(red, -red) == pytest.approx(180)
    assert angle(red, np.ones(3)) == pytest.approx(54.7356, abs=1e-3)
    assert angle(red, np.zeros(3)) == 90


def test_hue_angles_ignore_grey() -> None:
    red, green, blue = np.eye(3)
    assert hue_angle(red, 5 * red + 1) == pytest.approx(0, abs=1e-4)
    assert hue_angle(red, green) == pytest.approx(120) and hue_angle(blue, -blue) == pytest.approx(180)
    assert hue_angle(red, np.ones(3)) == pytest.approx(90)


def test_leakage_is_change_far_away_over_change_at_the_stroke() -> None:
    before = np.random.default_rng(3).uniform(size=(10, 10, 3)).astype(np.float32)
    drawn, far = np.zeros((2, 10, 10), bool)
    drawn[:3], far[7:] = True, True
    after = before.copy()
    after[drawn] += 0.4
    assert leakage(before, after, drawn, far) == 0 == leakage(before, before, drawn, far)
    after[far] -= 0.1
    assert leakage(before, after, drawn, far) == pytest.approx(0.25, rel=1e-4)
    assert leakage(before, before + np.float32(0.2), drawn, far) == pytest.approx(1)


def test_steps_that_make_it_worse() -> None:
    assert steps_not_worse([9, 7, 7.4, 5], 0.5) == 1
    assert steps_not_worse([9, 7, 7.4, 5], 0.1) == pytest.approx(2 / 3)
    assert steps_not_worse([1, 2, 3], 0.5) == 0


def test_borders_of_patches() -> None:
    rows, columns = np.indices((24, 32))
    ramp = np.stack([rows + 2.0 * columns] * 3, axis=-1).astype(np.float32)
    assert border_ratio(ramp, 8) == pytest.approx(1, abs=0.05)
    assert border_ratio(np.ones((16, 16, 3), np.float32), 8) == 1
    blocks = ramp * 0.01 + ((rows // 8 + columns // 8) % 2)[..., None].astype(np.float32)
    assert border_ratio(blocks, 8) > 20
    assert border_ratio(np.roll(blocks, 4, axis=(0, 1)), 8) < 0.2  # steps that are not at the borders
    noise = np.random.default_rng(4).normal(size=(128, 128, 3)).astype(np.float32)
    assert border_ratio(noise, 4) == pytest.approx(1, abs=0.03)


def test_a_map_is_judged_after_the_best_scale() -> None:
    truth = np.random.default_rng(5).uniform(0.05, 3, (16, 16, 3)).astype(np.float32)
    for scale in (0.1, 1, 7):
        assert scaled_psnr(truth * np.float32(scale), truth) > 60
    assert scaled_psnr(truth, 5 * truth) > 60
    tinted = truth * np.array([1, 0.5, 0.25], np.float32)
    flat = np.full_like(truth, 0.3)
    assert scaled_psnr(flat, truth) < scaled_psnr(tinted, truth) < 30
    # No other scale does better than the one that is found.
    noisy = truth * np.random.default_rng(6).uniform(0.5, 2, truth.shape).astype(np.float32)
    best = scaled_psnr(noisy, truth)
    assert all(scaled_psnr(noisy * np.float32(s), truth) == pytest.approx(best, abs=0.01) for s in (0.3, 3))
    assert np.isfinite(scaled_psnr(np.zeros_like(truth), truth))
