"""Cameras: plain sRGB where nothing is set, each flaw as large as stated, one photo from one seed."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import correlate1d

from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear
from dior_rt.training import light
from dior_rt.training.data.camera import (
    LUMA,
    Camera,
    eight_bits,
    jpeg_error,
    random_camera,
    softened,
    white_balance,
)

EXAMPLES = Path(__file__).parents[3] / "examples"
MANY = 300


def cameras(count: int = MANY) -> list[Camera]:
    return [random_camera(np.random.default_rng(seed)) for seed in range(count)]


def styled(count: int = MANY) -> list[Camera]:
    return [camera for camera in cameras(count) if camera != Camera()]


def ramp(size: int = 256) -> np.ndarray:
    """(1, size, 3) greys whose encoded values are evenly spaced in 0..1."""
    return np.repeat(srgb_to_linear(np.linspace(0, 1, size)).astype(np.float32)[None, :, None], 3, axis=2)


def any_light(height: int = 24, width: int = 40) -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 1, (height, width, 3)).astype(np.float32) ** 2


def photograph(name: str, size: int) -> Image.Image:
    return Image.open(EXAMPLES / f"{name}.jpg").convert("RGB").resize((size, size), Image.Resampling.LANCZOS)


def test_the_plain_camera_encodes_to_eight_bits_and_no_more() -> None:
    linear = any_light()
    photo = Camera().shot(linear, np.random.default_rng(0))
    assert photo.dtype == np.float32
    assert photo.shape == linear.shape
    np.testing.assert_array_less(np.abs(photo * 255 - linear_to_srgb(linear) * 255), 0.5 + 1e-4)
    np.testing.assert_array_equal(photo, eight_bits(photo) / np.float32(255))
    np.testing.assert_allclose(Camera().develop(linear), linear_to_srgb(linear), atol=1e-6)


def test_the_plain_camera_gives_the_codes_that_the_triplets_had() -> None:
    codes = srgb_to_linear(np.arange(256) / 255).astype(np.float32).reshape(16, 16, 1).repeat(3, axis=2)
    ours = Camera().shot(codes, np.random.default_rng(0))
    theirs = (light.linear_to_srgb(torch.from_numpy(codes)) * 255).round() / 255
    np.testing.assert_array_equal(ours, theirs.numpy())


def test_a_third_of_the_cameras_and_of_the_white_balances_are_plain() -> None:
    plain = np.mean([camera == Camera() for camera in cameras(900)])
    neutral = np.mean([(white_balance(np.random.default_rng(seed)) == 1).all() for seed in range(900)])
    assert 0.28 < plain < 0.39 and 0.28 < neutral < 0.39


def test_styles_rise_from_about_black_to_about_white_and_keep_greys_grey() -> None:
    for camera in styled():
        picture = camera.develop(ramp())[0]
        assert (np.diff(picture, axis=0) > 0).all(), camera
        assert picture[0].max() <= 0.03 and picture[-1].min() > 1 - 1e-5, camera
        assert (picture == picture[:, :1]).all(), camera


def test_styles_are_mild() -> None:
    """Greys stay within 0.15 of sRGB, and from 0.15 to 0.3 the light's slope within a half of 1."""
    sizes = [np.abs(c.develop(ramp()) - Camera().develop(ramp())).max() for c in styled()]
    assert max(sizes) < 0.15 and np.median(sizes) > 0.02
    dim, bright = (np.full((1, 1, 3), level, np.float32) for level in (0.15, 0.3))
    slopes = [
        np.log2(srgb_to_linear(c.develop(bright)) / srgb_to_linear(c.develop(dim))).item(0) for c in styled()
    ]
    assert min(slopes) > 0.75 and max(slopes) < 1.5
    assert abs(np.mean(slopes) - 1) < 0.15


@pytest.mark.parametrize("channel", range(3))
def test_each_channel_rises_with_its_own_light(channel: int) -> None:
    for camera in styled(60):
        for others in (0.02, 0.2, 0.7):
            linear = np.full((1, 64, 3), others, np.float32)
            linear[0, :, channel] = srgb_to_linear(np.linspace(0, 1, 64))
            levels = camera.develop(linear)[0, :, channel]
            inside = (levels > 0) & (levels < 1)
            assert (np.diff(levels) >= 0).all() and (np.diff(levels[inside]) > 0).all(), camera


def test_a_style_has_the_stated_equations() -> None:
    v = linear_to_srgb(any_light())
    known = {
        Camera(gamma=1.2): v**1.2,
        Camera(contrast=0.4): v + 0.4 * (3 * v**2 - 2 * v**3 - v),
        Camera(lift=0.03): 0.03 + 0.97 * v,
        Camera(saturation=0): np.repeat((v @ [0.2126, 0.7152, 0.0722])[..., None], 3, axis=2),
    }
    for camera, expected in known.items():
        np.testing.assert_allclose(camera.develop(any_light()), expected, atol=2e-6)


def test_any_camera_gives_codes_in_range_and_leaves_its_input_alone() -> None:
    linear = any_light(56, 80)
    before = linear.copy()
    for seed, camera in enumerate(cameras(60)):
        photo = camera.shot(linear, np.random.default_rng(seed))
        assert photo.shape == linear.shape and photo.dtype == np.float32
        assert photo.min() >= 0 and photo.max() <= 1
        np.testing.assert_array_equal(photo, np.rint(photo * 255).astype(np.float32) / np.float32(255))
    np.testing.assert_array_equal(linear, before)


def test_light_beyond_white_and_below_black_is_clipped() -> None:
    extremes = np.array([-1.0, 0.0, 1.0, 50.0], np.float32).repeat(3).reshape(1, 4, 3)
    for camera in cameras(30):
        low, black, white, high = camera.develop(extremes)[0]
        np.testing.assert_array_equal(low, black)
        np.testing.assert_array_equal(high, white)


def test_a_seed_gives_one_camera_and_one_photo() -> None:
    def once(seed: int) -> tuple[Camera, np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        camera = random_camera(rng)
        return camera, camera.shot(any_light(), rng), white_balance(rng)

    for seed in range(12):
        for first, again in zip(once(seed), once(seed), strict=True):
            np.testing.assert_array_equal(first, again)
    assert len(set(styled())) == len(styled())


@pytest.mark.parametrize("light", [0.05, 0.2, 0.5])
def test_noise_has_the_stated_variance(light: float) -> None:
    """Measured back in linear light: shot_noise * light + read_noise ** 2, and what rounding adds."""
    camera = Camera(shot_noise=4e-4, read_noise=4e-3)
    flat = np.full((128, 128, 3), light, np.float32)
    photo = srgb_to_linear(camera.shot(flat, np.random.default_rng(1)))
    code = linear_to_srgb(light) * 255
    step = srgb_to_linear((code + 0.5) / 255) - srgb_to_linear((code - 0.5) / 255)
    np.testing.assert_allclose(photo.var(), 4e-4 * light + 4e-3**2 + step**2 / 12, rtol=0.04)
    np.testing.assert_allclose(photo.mean(), light, rtol=0.01)


def test_noise_is_white_and_of_each_channel_alone() -> None:
    flat = np.full((128, 128, 3), 0.3, np.float32)
    noise = Camera(shot_noise=1e-3).shot(flat, np.random.default_rng(2)) - Camera().develop(flat)
    between = np.corrcoef(noise.reshape(-1, 3).T) - np.eye(3)
    beside = np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]
    assert np.abs(between).max() < 0.03 and abs(beside) < 0.03


def test_softening_is_a_blur_of_its_deviation_and_keeps_the_mean() -> None:
    point = np.zeros((9, 9, 1), np.float32)
    point[4, 4] = 1
    spread = softened(point, 0.5)[..., 0].astype(np.float64)
    places = np.arange(9) - 4
    np.testing.assert_allclose(spread.sum(), 1, rtol=1e-6)
    for axis in (0, 1):
        np.testing.assert_allclose((spread.sum(axis=axis) * places**2).sum(), 0.25, rtol=1e-6)
    raster = any_light()
    expected = raster
    for axis in (0, 1):
        expected = correlate1d(expected, [0.125, 0.75, 0.125], axis=axis, mode="nearest")
    np.testing.assert_allclose(softened(raster, 0.5), expected, atol=1e-6)


def test_blur_happens_to_light_before_it_is_encoded() -> None:
    point = np.zeros((5, 5, 3), np.float32)
    point[2, 2] = 1
    photo = Camera(blur=0.5).shot(point, np.random.default_rng(0))
    np.testing.assert_allclose(photo[2, 2], linear_to_srgb(0.75**2), atol=0.5 / 255 + 1e-6)


def test_sharpening_steepens_an_edge_and_leaves_flat_places() -> None:
    edge = np.full((8, 16, 3), 0.2, np.float32)
    edge[:, 8:] = 0.5
    plain, sharp = (c.shot(edge, np.random.default_rng(0)) for c in (Camera(), Camera(sharpening=0.5)))
    assert (sharp[:, 7] < plain[:, 7]).all() and (sharp[:, 8] > plain[:, 8]).all()
    np.testing.assert_array_equal(np.delete(sharp, (7, 8), axis=1), np.delete(plain, (7, 8), axis=1))


@pytest.mark.parametrize("name", ["astronaut", "chelsea", "coffee"])
@pytest.mark.parametrize("quality", [40, 75, 95])
def test_a_jpeg_leaves_of_a_photo_about_what_a_real_one_leaves(name: str, quality: int) -> None:
    """Against the JPEG of the photo itself, three pixels a cell: most of its error, and never more."""
    whole = photograph(name, 3 * 64)
    file = BytesIO()
    whole.save(file, "JPEG", quality=quality, subsampling="4:2:0")
    before, after = (
        np.asarray(picture.resize((64, 64), Image.Resampling.BOX), np.float32) / 255
        for picture in (whole, Image.open(file))
    )
    ratio = jpeg_error(before, quality, 3).std() / (after - before).std()
    assert 0.6 < ratio < 1.0


def test_a_jpeg_harms_less_at_higher_quality_and_finer_pixels_and_chroma_most() -> None:
    photo = np.asarray(photograph("astronaut", 64), np.float32) / 255
    coarse, middle, good = (jpeg_error(photo, quality, 3).std() for quality in (30, 60, 95))
    assert coarse > 1.2 * middle > 1.2 * good
    assert jpeg_error(photo, 60, 2).std() > 1.2 * jpeg_error(photo, 60, 3.5).std()
    error = jpeg_error(photo, 90, 3)
    luma = error @ LUMA
    assert (error - luma[..., None]).std() > luma.std()
    assert np.abs(jpeg_error(np.full((64, 80, 3), 0.5, np.float32), 60, 2.7)).max() <= 1.01 / 255


def test_white_balance_keeps_the_luminance_of_white_and_runs_from_warm_to_cool() -> None:
    gains = np.array([white_balance(np.random.default_rng(seed)) for seed in range(MANY)])
    np.testing.assert_allclose(gains @ LUMA, 1, atol=1e-6)
    assert gains.min() > 0.5 and gains.max() < 2
    tinted = np.log(gains[(gains != 1).any(axis=1)])
    warmth, tint = tinted[:, 0] - tinted[:, 2], tinted[:, 1] - tinted[:, [0, 2]].mean(axis=1)
    assert warmth.std() > 3 * tint.std()
    assert 0.35 < (warmth > 0).mean() < 0.65


def test_codes_are_the_nearest() -> None:
    np.testing.assert_array_equal(
        eight_bits(np.array([-0.1, 0.0, 0.0019, 0.002, 0.5, 1.0, 1.2])), [0, 0, 0, 1, 128, 255, 255]
    )


def test_only_the_style_reaches_a_developed_picture() -> None:
    """And without flaws a photo is that picture in eight bits."""
    for camera in styled(30):
        flawless = replace(camera, shot_noise=0, read_noise=0, blur=0, sharpening=0, quality=None)
        np.testing.assert_array_equal(camera.develop(any_light()), flawless.develop(any_light()))
        np.testing.assert_allclose(
            flawless.shot(any_light(), np.random.default_rng(0)),
            flawless.develop(any_light()),
            atol=0.501 / 255,
        )
