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
from dior_rt.cli.app import app
from dior_rt.cli.convert import _path_and_strength
from dior_rt.errors import InputError


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_folder_with_loras_becomes_a_bundle_that_knows_what_it_was_told(folders, tmp_path):
    lora = tmp_path / "lora.safetensors"
    save_file({"img_in.lora_A.weight": torch.ones(2, 16), "img_in.lora_B.weight": torch.ones(48, 2)}, lora)
    out = tmp_path / "bundle"
    done = run(
        "export", folders[True], "-o", out, "--lora", f"{lora}:0.5", "--few-steps", 4, "--weights", "fp32"
    )
    assert done.exit_code == 0, done.output
    assert "parity block" in done.output
    manifest = read_bundle(out).manifest
    assert (manifest.family, manifest.precision) == ("qwen", "fp32")
    assert (manifest.steps, manifest.guidance, manifest.schedule.shift) == (4, 1.0, 3.0)


def test_options_for_qwen_are_refused_on_other_folders(tmp_path):
    done = run("export", tmp_path, "-o", tmp_path / "out", "--prompt-cache")
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
    done = run(
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
