"""The torch functions of light compute what the runtime's NumPy functions compute."""

import numpy as np
import pytest
import torch

from dior_rt import light
from dior_rt.kernels import NumpyOps
from dior_rt.training import light as twin

LIGHT = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 200)]).astype(np.float32)


def test_the_srgb_curve_is_that_of_the_kernels() -> None:
    values, ops = torch.linspace(0, 1, 4097), NumpyOps()
    encoded, decoded = ops.encode_srgb(values.numpy(), np.float32), ops.decode_srgb(values.numpy())
    np.testing.assert_allclose(twin.linear_to_srgb(values), encoded, atol=2e-6)
    np.testing.assert_allclose(twin.srgb_to_linear(values), decoded, atol=2e-6)


@pytest.mark.parametrize("peak", [1.0, light.LUMI_PEAK])
def test_light_is_encoded_and_decoded_alike(peak: float) -> None:
    encoded = light.encode_lumi(LIGHT, peak)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(light.encode_lumi(np.float32([0, peak]), peak), [0, 1], atol=1e-6)
    np.testing.assert_allclose(twin.encode_lumi(torch.from_numpy(LIGHT), peak), encoded, rtol=1e-6)
    back = light.decode_lumi(encoded, peak)
    np.testing.assert_allclose(back, LIGHT, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(twin.decode_lumi(torch.from_numpy(encoded), peak), back, rtol=1e-4, atol=1e-6)


def test_a_ratio_of_light_is_taken_and_applied_alike() -> None:
    source, relit = LIGHT[:, None], LIGHT[None, ::7]
    ratio = light.log_ratio(relit, source)
    difference = twin.log_floored(torch.from_numpy(relit.copy())) - twin.log_floored(torch.from_numpy(source))
    np.testing.assert_allclose(difference, ratio, rtol=1e-5, atol=1e-5)
    back = light.apply_log_ratio(source, ratio)
    np.testing.assert_allclose(back, np.broadcast_to(relit, back.shape), rtol=1e-4, atol=1e-3)
    applied = twin.apply_log_ratio(torch.from_numpy(source), torch.from_numpy(ratio)).clamp_min(0)
    np.testing.assert_allclose(applied, back, rtol=1e-5, atol=1e-6)


def test_drawn_light_is_the_same_picture() -> None:
    rows = np.stack([LIGHT, LIGHT / 2, LIGHT / 4], axis=-1)[None]
    mask = np.ones(rows.shape[:2], np.float32)
    mask[:, ::5] = 0
    picture = light.draw_lumi(rows, mask)
    assert picture.dtype == np.uint8 and (picture[:, ::5] == 0).all()
    drawn = (twin.draw_lumi(torch.from_numpy(rows)) * torch.from_numpy(mask)[..., None]).numpy()
    assert np.abs(drawn * 255 - picture).max() <= 0.5 + 1e-4
    shown = picture.astype(np.float32) / 255
    back = light.undraw_lumi(shown)
    np.testing.assert_allclose(twin.undraw_lumi(torch.from_numpy(shown)), back, rtol=1e-5, atol=1e-6)


def test_latents_become_the_same_tokens_and_come_back() -> None:
    latents = np.random.default_rng(0).random((1, 4, 6, 10), np.float32)
    tokens = light.pack_patches(latents, 2)
    assert tokens.shape == (15, 16)
    np.testing.assert_array_equal(twin.pack_patches(torch.from_numpy(latents[0])), tokens)
    np.testing.assert_array_equal(light.unpack_patches(tokens, (3, 5), 2), latents)
    np.testing.assert_array_equal(twin.unpack_patches(torch.from_numpy(tokens), (3, 5)), latents[0])
