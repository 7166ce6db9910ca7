"""`dior-rt export` on a folder of Qwen-Image-Edit."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from typer.testing import CliRunner

from dior_rt.bundle import read_bundle
from dior_rt.cli import run
from dior_rt.cli.app import app
from dior_rt.cli.convert import _path_and_strength
from dior_rt.errors import InputError


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_folder_with_loras_becomes_a_bundle_that_knows_what_it_was_told(folders, tmp_path):
    lora = tmp_path / "lora.safetensors"
    save_file({"img_in.lora_A.weight": torch.ones(2, 16), "img_in.lora_B.weight": torch.ones(48, 2)}, lora)
    out = tmp_path / "bundle"
    done = invoke(
        "export", folders[True], "-o", out, "--lora", f"{lora}:0.5", "--few-steps", 4, "--weights", "fp32"
    )
    assert done.exit_code == 0, done.output
    assert "parity block" in done.output
    manifest = read_bundle(out).manifest
    assert (manifest.family, manifest.precision) == ("qwen", "fp32")
    assert (manifest.steps, manifest.guidance, manifest.schedule.shift) == (4, 1.0, 3.0)


def test_options_for_qwen_are_refused_on_other_folders(tmp_path):
    done = invoke("export", tmp_path, "-o", tmp_path / "out", "--prompt-cache")
    assert isinstance(done.exception, InputError) and "is no Qwen-Image-Edit" in str(done.exception)


@pytest.mark.parametrize(
    ("text", "path", "strength"),
    [
        ("a.safetensors", "a.safetensors", 1.0),
        ("a.safetensors:0.8", "a.safetensors", 0.8),
        ("a.safetensors:-1", "a.safetensors", -1.0),
        ("C:/loras/a.safetensors", "C:/loras/a.safetensors", 1.0),
        ("C:/loras/a.safetensors:2", "C:/loras/a.safetensors", 2.0),
    ],
)
def test_a_strength_may_follow_a_colon(text, path, strength):
    found, number = _path_and_strength(text)
    assert (found.as_posix(), number) == (path, strength)


def test_relight_runs_the_bundle_on_a_photo_and_strokes(make, tmp_path):
    Image.fromarray(np.full((60, 80, 3), 120, np.uint8)).save(tmp_path / "photo.png")
    strokes = np.zeros((60, 80, 4), np.uint8)
    strokes[10:20, 10:30] = 255
    Image.fromarray(strokes).save(tmp_path / "strokes.png")
    bundle = shutil.copytree(make(steps=6, free_steps=False), tmp_path / "bundle")
    out = tmp_path / "relit.png"
    done = invoke(
        "relight",
        tmp_path / "photo.png",
        tmp_path / "strokes.png",
        "-o",
        out,
        "--bundle",
        bundle,
        "--device",
        "cpu",
    )
    assert done.exit_code == 0, done.output
    assert Image.open(out).size == (80, 60)


def lora_of(layer, width):
    def write(folder, tmp_path):
        path = tmp_path / "lora.safetensors"
        tensors = {
            f"{layer}.lora_A.weight": torch.ones(2, width),
            f"{layer}.lora_B.weight": torch.ones(48, 2),
        }
        save_file(tensors, path)
        return ["--lora", str(path)]

    return write


def without_a_shard(folder, tmp_path):
    next((folder / "transformer").glob("*00003-of*")).unlink()
    return []


def cut_short(folder, tmp_path):
    shard = sorted((folder / "text_encoder").glob("*.safetensors"))[-1]
    shard.write_bytes(shard.read_bytes()[:-64])
    return []


def without_words(folder, tmp_path):
    shutil.rmtree(folder / "tokenizer")
    return []


@pytest.mark.parametrize(
    ("spoil", "saying"),
    [
        (lora_of("transformer_blocks.0.attn.to_x", 48), "is for another model"),
        (lora_of("img_in", 99), "does not fit this model"),
        (without_a_shard, "lacks 1 of its 23 shards"),
        (cut_short, "is cut short or is no safetensors file"),
        (without_words, "Cannot read the tokenizer"),
        (lambda folder, tmp_path: ["--lora", str(tmp_path / "none")], "is missing"),
        (lambda folder, tmp_path: ["--vae", str(folder / "model_index.json")], "is no safetensors file"),
    ],
    ids=["lora's keys", "lora's width", "shard", "cut", "tokenizer", "no lora", "no weights"],
)
def test_what_cannot_be_exported_is_one_sentence_and_leaves_nothing(folders, tmp_path, capfd, spoil, saying):
    folder = shutil.copytree(folders[True], tmp_path / "model")
    out = tmp_path / "bundles" / "bundle"
    options = spoil(folder, tmp_path)
    assert run(["export", str(folder), "-o", str(out), "--weights", "fp32", *options]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and said.startswith("dior-rt: ") and saying in said, said
    assert not out.parent.exists() or not list(out.parent.iterdir())


def test_a_full_disk_is_one_sentence_and_leaves_nothing(folders, tmp_path, capfd, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    assert run(["export", str(folders[True]), "-o", str(tmp_path / "bundle")]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "Too little room" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("how", ["cut", "altered", "missing"])
def test_a_spoilt_bundle_is_one_sentence_and_no_picture(make, tmp_path, capfd, how):
    bundle, out = shutil.copytree(make(), tmp_path / "bundle"), tmp_path / "relit.png"
    Image.fromarray(np.full((32, 32, 3), 120, np.uint8)).save(tmp_path / "photo.png")
    Image.fromarray(np.full((32, 32, 4), 255, np.uint8)).save(tmp_path / "strokes.png")
    file = bundle / "transformer" / "block.01.data"
    data = bytearray(file.read_bytes())
    file.unlink()
    if how != "missing":
        data[100] ^= 1
        file.write_bytes(data[:-1000] if how == "cut" else data)
    photo, strokes = str(tmp_path / "photo.png"), str(tmp_path / "strokes.png")
    assert run(["relight", photo, strokes, "-o", str(out), "--bundle", str(bundle)]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and said.startswith("dior-rt: ") and "block.01.data" in said, said
    assert not out.exists()
