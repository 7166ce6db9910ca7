"""A qwen bundle behind the same door as every other."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_qwen
import torch
from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as edit_plus
from PIL import Image

from dior_rt import Relighter
from dior_rt.families.qwen.frame import shrink


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


@pytest.fixture(scope="module")
def relighter(make):
    return Relighter(make(steps=2, free_steps=False), device="cpu", ops="numpy")


def smooth_and_sharp(height, width):
    """A photo with all that resampling can tell apart: edges, lines of one pixel, noise."""
    photo = np.asarray(tiny_qwen.picture(width, height)).copy()
    photo[height // 3 :: 7] //= 3
    photo[:, width // 4 :: 11] = 255 - photo[:, width // 4 :: 11]
    return photo


def test_beyond_the_strokes_reach_the_photo_stays(relighter):
    photo = smooth_and_sharp(90, 120)
    strokes = np.zeros((90, 120, 4), np.float32)
    strokes[40:50, 10:20] = 1
    far, near = (relighter.relight(photo, strokes, reach=reach).picture.astype(int) for reach in (None, 0.1))
    still = np.s_[:, 70:]  # four reaches from the strokes
    assert np.abs(near[still] - photo[still]).max() <= 1 < np.abs(far[still] - photo[still]).mean()
    assert np.abs(near[43:47, 13:17] - far[43:47, 13:17]).max() <= 1


@pytest.mark.parametrize("size", [(384, 384), (333, 333), (256, 512), (96, 96)], ids=str)
def test_a_photo_is_shrunk_as_diffusers_processor_does(relighter, pipes, size):
    # Shapes whose canvas has no border, so that diffusers' own rule for sizes gives the same canvas.
    photo, pipe = smooth_and_sharp(*size), pipes[True]
    family = relighter._family
    raster = family.raster(*size)
    canvas = edit_plus.calculate_dimensions(edit_plus.VAE_IMAGE_SIZE, size[1] / size[0])[::-1]
    assert tuple(canvas) == raster
    _, seen = relighter._family.reduce_photo(photo, raster, relighter._ops)
    wanted = pipe.image_processor.preprocess(Image.fromarray(photo), *canvas)
    codes = (np.rint(picture * 255) for picture in (seen.transpose(2, 0, 1), (wanted[0].numpy() + 1) / 2))
    np.testing.assert_array_equal(*codes)
    with torch.no_grad():
        latents = pipe._encode_vae_image(wanted[:, :, None], torch.Generator())
    rows, columns = raster[0] // 8, raster[1] // 8
    packed = pipe._pack_latents(latents, 1, 4, rows, columns)[0].numpy()
    got = family.encode(seen, None, "estimate").references
    assert np.abs(got - packed).max() <= 1e-4 * np.abs(packed).max()


def test_deeper_photos_are_shrunk_like_those_of_8_bits():
    photo = smooth_and_sharp(120, 90)
    small = shrink(photo, (40, 30))
    for deep in (photo.astype(np.uint16) * 257, photo.astype(np.float32) / 255):
        got = shrink(deep, (40, 30))
        assert got.dtype == np.float32 and got.min() >= 0 and got.max() <= 1
        # In 8 bits Pillow rounds and clips between its two passes, which shows beside the sharpest edges.
        assert np.abs(got - small).mean() < 0.3 / 255 and np.abs(got - small).max() < 0.05


@pytest.fixture
def copying(relighter, monkeypatch):
    """A relighter whose model paints the photo that it is shown, through an autoencoder without loss.

    Whatever still stands between photo and result, borders, shrinking, enlarging, has to be undone.
    """

    def encode(pixels):
        return torch.nn.functional.pixel_unshuffle(torch.from_numpy(pixels), 8).numpy()

    def decode(latents):
        return torch.nn.functional.pixel_shuffle(torch.from_numpy(latents), 8).numpy()

    def velocity(condition, sigmas, guidance):
        rows, columns = condition.sizes[0]
        copy = condition.references[: rows * columns]
        return lambda x, sigma: (x - copy) / np.float32(sigma)

    monkeypatch.setattr(relighter._family, "_encode", encode)
    monkeypatch.setattr(relighter._family, "_decode", decode)
    monkeypatch.setattr(relighter._family, "velocity", velocity)
    return relighter


def strokes_for(height, width):
    strokes = np.zeros((height, width, 4), np.float32)
    strokes[: height // 2, : width // 2] = (2.0, 1.0, 0.5, 1.0)
    return strokes


@pytest.mark.parametrize("size", [(300, 200), (131, 203), (97, 96), (500, 61), (96, 96), (90, 101)], ids=str)
def test_the_result_lies_on_the_photo_to_the_pixel(copying, size):
    photo = smooth_and_sharp(*size)
    np.testing.assert_array_equal(copying.relight(photo, strokes_for(*size)).picture, photo)


@pytest.mark.parametrize("size", [(40, 33), (27, 60)], ids=str)
def test_a_small_photo_is_enlarged_for_the_model_and_comes_back_in_place(copying, size):
    photo = np.asarray(tiny_qwen.picture(*size[::-1]))
    relit = copying.relight(photo, strokes_for(*size)).picture.astype(float)
    inside = (slice(2, -2), slice(2, -2))
    shifts = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    errors = {s: np.abs(np.roll(relit, s, (0, 1)) - photo)[inside].mean() for s in shifts}
    others = [error for shift, error in errors.items() if shift != (0, 0)]
    assert errors[0, 0] < 1 and errors[0, 0] < 0.2 * min(others)
