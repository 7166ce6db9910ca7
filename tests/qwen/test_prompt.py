"""The prompt's way against diffusers' and transformers' own: words, patches, vision tower, language model."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny_qwen
import torch
from PIL import Image

from dior_rt.bundle import read_bundle
from dior_rt.errors import InputError
from dior_rt.export.qwen.sources import Sources
from dior_rt.export.qwen.text import TextConfig
from dior_rt.families.qwen.frame import fit_area, resize
from dior_rt.families.qwen.model import Qwen
from dior_rt.families.qwen.prompt import PromptEncoder, patchify, whole_patches, window_order
from dior_rt.families.qwen.template import PICTURE, TEMPLATE

WORDS = "light it from the left"


def pictures_of(*sizes):
    return [np.asarray(tiny_qwen.picture(w, h, seed)) for seed, (h, w) in enumerate(sizes)]


def encode_by_diffusers(pipe, pictures, words=WORDS):
    conditions = [
        Image.fromarray(resize(p, fit_area(64 * 64, *p.shape[:2], 32), Image.Resampling.LANCZOS))
        for p in pictures
    ]
    with torch.no_grad():
        embeddings, mask = pipe.encode_prompt(words, conditions or None)
    assert mask is None
    return embeddings[0].numpy()


@pytest.mark.parametrize(
    "sizes", [[(96, 96), (96, 96)], [(40, 130), (40, 130)], [(300, 111), (64, 90)]], ids=str
)
def test_embeddings_of_a_prompt_with_pictures_are_those_of_diffusers(qwens, pipes, sizes):
    pictures = pictures_of(*sizes)
    encoder = qwens[True]._prompts
    got = encoder.encode("relight", encoder.look(pictures))
    want = encode_by_diffusers(pipes[True], pictures)
    assert got.shape == want.shape
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_the_order_of_the_pictures_matters(qwens):
    encoder = qwens[True]._prompts
    features = encoder.look(pictures_of((96, 96), (96, 96)))
    one, other = (encoder.encode("relight", f) for f in (features, features[::-1]))
    assert np.abs(one - other).max() > 0.01


@pytest.mark.parametrize("length", range(1, 6))
def test_prompts_of_every_length_agree(folders, pipes, qwens, length):
    # The number of words decides nothing but the number of rows: 64 are dropped from the front, always.
    words = "abcdefg"[:length]
    ids = Sources(folders[True]).word_ids(words, pictures=2)
    encoder = qwens[True]._prompts
    pictures = pictures_of((64, 64), (64, 64))
    sources = Sources(folders[True])
    rows = sources.text_weights.rows("model.embed_tokens.weight", range(264))
    settings = replace(encoder._settings, prompts={"other": ids})
    other = PromptEncoder(settings, dict(enumerate(rows)), qwens[True].layers)
    got = other.encode("other", other.look(pictures))
    want = encode_by_diffusers(pipes[True], pictures, words)
    assert got.shape == want.shape
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_patches_are_those_of_the_processor(qwens, pipes):
    vision = qwens[True].settings.text.vision
    picture = pictures_of((70, 121))[0]
    patches, grid = patchify(vision, picture)
    small = resize(picture, fit_area(64 * 64, 70, 121, 32), Image.Resampling.LANCZOS)
    want = pipes[True].processor.image_processor(Image.fromarray(small), return_tensors="np")
    assert tuple(want["image_grid_thw"][0]) == (1, *grid)
    np.testing.assert_allclose(patches, want["pixel_values"], atol=1e-5)


@pytest.mark.parametrize("size", [(10, 10), (28, 4000), (392, 392), (5000, 3000), (57, 100)], ids=str)
def test_whole_patches_follow_the_processor(qwens, pipes, size):
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

    vision = qwens[True].settings.text.vision
    want = smart_resize(*size, 28, vision.least_pixels, vision.most_pixels)
    assert whole_patches(vision, *size) == want


@pytest.mark.parametrize("grids", [[(2, 2)], [(28, 28), (20, 36)], [(10, 6), (2, 18), (8, 8)]], ids=str)
def test_windows_follow_transformers(qwens, grids):
    from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import get_vision_window_index

    thw = torch.tensor([(1, *grid) for grid in grids])
    want, ends = get_vision_window_index(thw, spatial_merge_size=2, window_size=112, patch_size=14)
    order, windows = window_order(qwens[True].settings.text.vision, grids)
    np.testing.assert_array_equal(order, want.numpy())
    np.testing.assert_array_equal(np.flatnonzero(np.diff(windows)) + 1, ends.numpy()[1:-1])


def test_word_ids_are_those_of_the_processor(folders, pipes):
    ids = Sources(folders[True]).word_ids(WORDS, pictures=2)
    text = TEMPLATE.format(PICTURE.format(1) + PICTURE.format(2) + WORDS)
    assert pipes[True].prompt_template_encode == TEMPLATE
    assert list(ids) == pipes[True].tokenizer(text)["input_ids"]


def test_a_prompt_cache_holds_the_embeddings_without_pictures_and_no_encoder(make, pipes):
    folder = make(prompt_cache=True, steps=4, free_steps=False)
    qwen = Qwen(read_bundle(folder), "cpu")
    assert not (folder / "text").exists() and qwen.settings.text is None
    photo = np.full((96, 96, 3), 0.5, np.float32)
    condition = qwen.encode(photo, None, "relight")
    text = TEMPLATE.format(WORDS)
    tokens = pipes[True].tokenizer(text, return_tensors="pt")
    with torch.no_grad():
        out = pipes[True].text_encoder(**tokens, output_hidden_states=True)
    want = out.hidden_states[-1][0, 64:].numpy()
    got = qwen._text("relight", condition)
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_configs_written_by_older_transformers_are_read(folders, tmp_path):
    # The released model's config is flat and calls the rotary settings rope_scaling and rope_theta.
    folder = tmp_path / "text_encoder"
    shutil.copytree(folders[True] / "text_encoder", folder)
    config = json.loads((folder / "config.json").read_text())
    text = config.pop("text_config")
    rope = text.pop("rope_parameters")
    flat = {
        **config,
        **{name: value for name, value in text.items() if name not in ("model_type", "layer_types")},
        "rope_theta": rope["rope_theta"],
        "rope_scaling": {"type": "mrope", "mrope_section": rope["mrope_section"]},
    }
    flat["vision_config"].pop("rope_parameters", None)
    (folder / "config.json").write_text(json.dumps(flat))
    read = TextConfig.read(folder)
    assert list(read.text.rope_parameters["mrope_section"]) == [1, 1, 2]
    assert read.text.rope_parameters["rope_theta"] == 1e6
    assert read.text.num_key_value_heads == 2 and read.vision.rope_parameters["rope_theta"] == 1e4


def test_a_tokenizer_without_the_word_for_a_picture_is_refused(folders, tmp_path):
    folder = tmp_path / "model"
    shutil.copytree(folders[True], folder)
    for name in ("tokenizer.json", "tokenizer_config.json"):
        path = folder / "tokenizer" / name
        path.write_text(path.read_text().replace("<|image_pad|>", "<|other_pad|>"))
    with pytest.raises(InputError, match="does not know the word for a picture"):
        Sources(folder).word_ids(WORDS, pictures=2)
