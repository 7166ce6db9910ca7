"""The autoencoder's graphs against diffusers, whole and in tiles."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_qwen
import torch

from dior_rt.export.qwen.errors import psnr
from dior_rt.families.qwen.vae import decode_tiled, encode_tiled


@pytest.fixture(scope="module")
def vae():
    return tiny_qwen.vae()


def statistics(vae):
    return (
        np.array(v, np.float32).reshape(1, -1, 1, 1)
        for v in (vae.config.latents_mean, vae.config.latents_std)
    )


@pytest.mark.parametrize("size", [(16, 16), (32, 96), (104, 56)], ids=str)
def test_encoder_gives_the_normalised_mean(qwens, vae, size):
    pixels = np.random.default_rng(0).uniform(-1, 1, (1, 3, *size)).astype(np.float32)
    with torch.no_grad():
        mean = vae.encode(torch.from_numpy(pixels)[:, :, None]).latent_dist.mode()[:, :, 0].numpy()
    centre, spread = statistics(vae)
    want = (mean - centre) / spread
    got = qwens[True].layers.run("vae.encoder", {"pixels": pixels})["latents"]
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


@pytest.mark.parametrize("size", [(2, 2), (5, 12)], ids=str)
def test_decoder_paints_what_diffusers_paints(qwens, vae, size):
    latents = np.random.default_rng(1).standard_normal((1, 4, *size), dtype=np.float32)
    centre, spread = statistics(vae)
    with torch.no_grad():
        want = vae.decode(torch.from_numpy(latents * spread + centre)[:, :, None]).sample[:, :, 0].numpy()
    got = qwens[True].layers.run("vae.decoder", {"latents": latents})["pixels"]
    assert want.std() > 0.1
    assert np.abs(got - want).max() <= 1e-4


@pytest.mark.parametrize("size", [(3, 3), (9, 4), (16, 25)], ids=str)
def test_tiles_of_a_local_map_join_without_a_seam(size):
    # For a decoder without borders, any blend whose weights sum to 1 must give back what the whole gives.
    latents = np.random.default_rng(2).standard_normal((1, 2, *size), dtype=np.float32)

    def enlarge(z):
        return z.repeat(8, axis=2).repeat(8, axis=3)

    got = decode_tiled(enlarge, latents, 8, tile=6, overlap=2)
    np.testing.assert_allclose(got, enlarge(latents), rtol=1e-5, atol=1e-6)
    back = encode_tiled(lambda p: p[:, :, ::8, ::8], got, 8, tile=6, overlap=2)
    np.testing.assert_allclose(back, latents, rtol=1e-5, atol=1e-6)


def test_no_tile_is_larger_than_asked(qwens):
    sizes = []

    def decode(z):
        sizes.append(z.shape[2:])
        return z.repeat(8, axis=2).repeat(8, axis=3)

    decode_tiled(decode, np.zeros((1, 1, 37, 11), np.float32), 8, tile=12, overlap=4)
    assert len(sizes) == 5 and max(max(size) for size in sizes) <= 12


def test_tiled_decoding_stays_near_the_whole(qwens):
    # Real borders and the attention over all pixels differ from tile to tile; the blend keeps that small.
    def decode(z):
        return qwens[True].layers.run("vae.decoder", {"latents": np.ascontiguousarray(z)})["pixels"]

    latents = np.random.default_rng(3).standard_normal((1, 4, 24, 32), dtype=np.float32)
    whole = decode(latents)
    assert psnr(decode_tiled(decode, latents, 8, tile=16, overlap=8) / 2, whole / 2) > 35
