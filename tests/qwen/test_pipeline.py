"""The whole way of a picture against diffusers' QwenImageEditPlusPipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny_qwen
import torch
from agreement_qwen import RECIPE
from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as edit_plus
from loras_qwen import write_lora
from PIL import Image

from dior_rt.bundle import read_bundle
from dior_rt.errors import InputError
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.export.qwen.errors import probe_strokes, psnr, relative
from dior_rt.export.qwen.lora import Lora
from dior_rt.families.qwen.model import Qwen, rescaled
from dior_rt.flow.sampler import draw_noise, sample
from dior_rt.kernels import Strokes
from dior_rt.light import pack_patches, unpack_patches

PROMPT = "light it from the left"


def photo_of(height, width, seed=0):
    return np.asarray(tiny_qwen.picture(width, height, seed), np.float32) / 255


def run(qwen, condition, steps, guidance, seed=0):
    """The state at the end of the flow."""
    sigmas = qwen.sigmas(steps, condition)
    noise = draw_noise(seed, qwen.noise_shape(condition))
    *_, last = sample(qwen.velocity(condition, sigmas, guidance), noise, sigmas)
    return last.x


def run_diffusers(pipe, pictures, canvas, steps, guidance, noise, monkeypatch):
    """The picture that diffusers paints from the same pictures and noise."""
    # Its rule for the size of a reference, applied to one that has its size already, must keep it.
    monkeypatch.setattr(edit_plus, "VAE_IMAGE_SIZE", canvas[0] * canvas[1])
    images = pipe(
        [Image.fromarray(picture) for picture in pictures],
        PROMPT,
        negative_prompt=" ",
        true_cfg_scale=guidance,
        num_inference_steps=steps,
        height=canvas[0],
        width=canvas[1],
        latents=torch.from_numpy(noise)[None],
        output_type="np",
    )
    return images.images[0]


@pytest.mark.parametrize(
    ("zero", "size"),
    [
        (True, (64, 128)),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [(True, (96, 96)), (False, (96, 96)), (False, (128, 64)), (True, (150, 70))]
        ),
    ],
    ids=str,
)
def test_forty_steps_paint_the_picture_that_diffusers_paints(qwens, pipes, monkeypatch, zero, size):
    qwen = qwens[zero]
    photo, strokes = photo_of(*size), probe_strokes(size)
    condition = qwen.encode(photo, strokes, "relight")
    frame = condition.frame
    pictures = [
        frame.pad(np.rint(photo * 255).astype(np.uint8), mirror=True),
        frame.pad(qwen.draw(strokes), mirror=False),
    ]
    noise = draw_noise(0, qwen.noise_shape(condition))
    want = run_diffusers(pipes[zero], pictures, frame.canvas, 40, 4.0, noise, monkeypatch)
    got = qwen.decode_relit(run(qwen, condition, 40, 4.0), condition)
    assert want.std() > 0.02
    assert psnr(got, frame.crop(want)) >= 50


def test_without_guidance_one_branch_is_what_diffusers_paints(qwens, pipes, monkeypatch):
    qwen, photo, strokes = qwens[True], photo_of(96, 96), probe_strokes((96, 96))
    condition = qwen.encode(photo, strokes, "relight")
    pictures = [np.rint(photo * 255).astype(np.uint8), qwen.draw(strokes)]
    noise = draw_noise(0, qwen.noise_shape(condition))
    want = run_diffusers(pipes[True], pictures, (96, 96), 8, 1.0, noise, monkeypatch)
    assert psnr(qwen.decode_relit(run(qwen, condition, 8, 1.0), condition), want) >= 50


def test_only_the_right_guidance_and_light_paint_that_picture(qwens, pipes, monkeypatch):
    # What keeps the bars above honest: the picture depends on all that they are to prove.
    qwen, photo, strokes = qwens[True], photo_of(96, 96), probe_strokes((96, 96))
    condition = qwen.encode(photo, strokes, "relight")
    dark = qwen.encode(photo, Strokes(0 * strokes.light, strokes.mask), "relight")
    pictures = [np.rint(photo * 255).astype(np.uint8), qwen.draw(strokes)]
    noise = draw_noise(0, qwen.noise_shape(condition))
    want = run_diffusers(pipes[True], pictures, (96, 96), 8, 4.0, noise, monkeypatch)
    got = psnr(qwen.decode_relit(run(qwen, condition, 8, 4.0), condition), want)
    for other, guidance in ((condition, 1.0), (condition, 3.9), (dark, 4.0)):
        assert got > 10 + psnr(qwen.decode_relit(run(qwen, other, 8, guidance), other), want)


@pytest.mark.parametrize("steps", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_a_few_step_lora_beside_another_paints_what_diffusers_paints(folders, tmp_path, monkeypatch, steps):
    # As Lightning is published: bare keys with alpha, and the scheduler's settings that go with it.
    light = write_lora(tmp_path / "light.safetensors", "diffusers", rank=4)
    fast = write_lora(tmp_path / "fast.safetensors", "bare", rank=4, alpha=16, seed=5)
    shift = {"base_shift": np.log(3), "max_shift": np.log(3), "shift_terminal": None}
    pipe = tiny_qwen.pipeline(scheduler={**tiny_qwen.SCHEDULER, **shift})
    pipe.load_lora_weights(str(light), adapter_name="light")
    pipe.load_lora_weights(str(fast), adapter_name="fast")
    pipe.set_adapters(["light", "fast"], [1.25, 0.8])
    recipe = replace(RECIPE, free_steps=False).few_steps(steps)
    loras = [Lora(light, 1.25), Lora(fast, 0.8)]
    qwen = Qwen(export_qwen(folders[True], tmp_path / "bundle", recipe, loras=loras), "cpu")

    photo, strokes = photo_of(96, 96), probe_strokes((96, 96))
    condition = qwen.encode(photo, strokes, "relight")
    pictures = [np.rint(photo * 255).astype(np.uint8), qwen.draw(strokes)]
    noise = draw_noise(0, qwen.noise_shape(condition))
    want = run_diffusers(pipe, pictures, (96, 96), steps, 1.0, noise, monkeypatch)
    got = psnr(qwen.decode_relit(run(qwen, condition, steps, 1.0), condition), want)
    pipe.set_adapters(["light"], [1.25])
    without = run_diffusers(pipe, pictures, (96, 96), steps, 1.0, noise, monkeypatch)
    assert got >= 50 and got > 20 + psnr(without, want)


def test_guidance_of_zero_and_one_are_the_two_branches(qwens):
    qwen = qwens[True]
    condition = qwen.encode(photo_of(64, 64), probe_strokes((64, 64)), "relight")
    sigmas = qwen.sigmas(4, condition)
    x = draw_noise(1, qwen.noise_shape(condition))
    v = {scale: qwen.velocity(condition, sigmas, scale)(x, float(sigmas[1])) for scale in (0, 0.5, 1, 4)}
    for scale in (0.5, 4):
        want = rescaled(v[0] + np.float32(scale) * (v[1] - v[0]), v[1])
        assert relative(v[scale], want) < 1e-5
    assert relative(v[0], v[1]) > 0.01


def test_a_token_without_guided_velocity_stays_without(qwens):
    v = np.array([[0.0, 0.0], [3.0, 4.0]], np.float32)
    np.testing.assert_allclose(
        rescaled(v, np.ones_like(v)), [[0, 0], [0.6 * 2**0.5, 0.8 * 2**0.5]], rtol=1e-6
    )


def test_a_bundle_for_fixed_steps_computes_what_a_free_one_does(make):
    # A square has the number of tokens that the table is for.
    photo, strokes = photo_of(96, 96), probe_strokes((96, 96))
    ends = []
    for free in (True, False):
        qwen = Qwen(read_bundle(make(free_steps=free, steps=6)), "cpu")
        condition = qwen.encode(photo, strokes, "relight")
        ends.append(run(qwen, condition, 6, 4.0))
    assert relative(*ends) < 1e-5


def test_a_bundle_for_fixed_steps_names_them_when_asked_for_others(make):
    qwen = Qwen(read_bundle(make(free_steps=False, steps=6)), "cpu")
    condition = qwen.encode(photo_of(96, 96), None, "estimate")
    with pytest.raises(InputError, match="exported for 6 steps, not 7"):
        qwen.sigmas(7, condition)


def test_weights_that_memory_cannot_hold_give_the_same_picture(make):
    bundle = read_bundle(make())
    photo, strokes = photo_of(64, 96), probe_strokes((64, 96))
    ends = []
    for memory in (0, 10**6, 10**12):
        qwen = Qwen(bundle, "cpu", memory=memory)
        ends.append(run(qwen, qwen.encode(photo, strokes, "relight"), 2, 4.0))
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_tokens_and_latents_are_each_others_inverse():
    latents = np.random.default_rng(0).standard_normal((1, 4, 6, 10), dtype=np.float32)
    tokens = pack_patches(latents, 2)
    assert tokens.shape == (15, 16)
    np.testing.assert_array_equal(unpack_patches(tokens, (3, 5), 2), latents)
    packed = edit_plus.QwenImageEditPlusPipeline._pack_latents(torch.from_numpy(latents), 1, 4, 6, 10)
    np.testing.assert_array_equal(tokens, packed[0].numpy())


def test_the_drawing_of_light_can_be_read_back(qwens):
    light = np.random.default_rng(0).uniform(0, 4, (8, 8, 3)).astype(np.float32)
    mask = np.ones((8, 8), np.float32)
    mask[0] = 0
    drawn = qwens[True].draw(Strokes(light, mask))
    assert (drawn[0] == 0).all()
    back = qwens[True].undraw(drawn.astype(np.float32) / 255)
    np.testing.assert_allclose(back[1:], light[1:], atol=0.04)
