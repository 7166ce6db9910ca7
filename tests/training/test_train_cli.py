"""`dior-rt train`: from nothing to a checkpoint and its figures, and one sentence for what cannot be."""

import json
from functools import partial

import pytest

from dior_rt.cli import run
from dior_rt.training.data import render
from dior_rt.training.network import Config, Mini, load_network, save_network

SIZE = ("--width", "16", "--depth", "1", "--heads", "2", "--batch", "2")


def test_render_fit_lora_and_eval(tmp_path, monkeypatch, mini_bundle, capfd) -> None:
    monkeypatch.setattr(render, "view", partial(render.view, resolution=16, samples=1))
    renders, stage1, stage2 = (str(tmp_path / name) for name in ("renders", "stage1", "stage2"))
    assert run(["train", "render", "--scenes", "1", "--out", renders]) == 0
    assert len(list((tmp_path / "renders").iterdir())) == 2
    assert run(["train", "fit", renders, "--out", stage1, "--steps", "2", *SIZE]) == 0
    base = tmp_path / "stage1" / "model.safetensors"
    assert load_network(base).config == Config(16, 1, 2)
    lora = ["lora", str(base), renders, "--out", stage2, "--steps", "1", "--rank", "2", "--batch", "2"]
    assert run(["train", *lora]) == 0
    assert (tmp_path / "stage2" / "lora" / "adapter_model.safetensors").is_file()
    capfd.readouterr()
    measure = ["train", "eval", str(mini_bundle), renders, "--views", "1", "--dabs", "1"]
    assert run([*measure, "--steps", "1", "--reach", "0.2", "--json"]) == 0
    asked = json.loads(capfd.readouterr().out)
    assert asked["settings"]["steps"] == 1 and asked["settings"]["reach"] == 0.2
    assert [table["benchmark"] for table in asked["tables"]] == ["replace", "change"]
    refused([*measure[1:], "--reach", "-1", "--out", str(tmp_path / "no")], capfd, "reach must be a number")
    assert not (tmp_path / "no").exists()
    report = str(tmp_path / "report")
    assert run([*measure, "--out", report]) == 0
    assert capfd.readouterr().out.count("replace, 1 pictures") == 1
    assert {path.name for path in (tmp_path / "report").iterdir()} == {
        "report.json",
        "report.md",
        "contact.png",
    }


def refused(arguments: list[str], capfd, saying: str) -> None:
    assert run(["train", *arguments]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and said.startswith("dior-rt: ") and saying in said, said


@pytest.mark.parametrize("shard", ["2/2", "-1/2", "0", "a/b", "1/"])
def test_a_shard_that_is_none(shard, tmp_path, capfd) -> None:
    refused(["render", "--out", str(tmp_path / "r"), "--shard", shard], capfd, "i/n")
    assert not (tmp_path / "r").exists()


def test_a_folder_without_renders(tmp_path, capfd) -> None:
    refused(["fit", str(tmp_path), "--out", str(tmp_path / "run")], capfd, "There are no renders in")
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_made(tmp_path, renders, capfd) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        refused(["render", "--out", str(out), "--scenes", "1"], capfd, "Cannot make the folder")
        refused(["fit", str(renders), "--out", str(out), *SIZE], capfd, "Cannot make the folder")


def test_options_that_cannot_be_used(tmp_path, renders, mini_bundle, capfd) -> None:
    out = ["--out", str(tmp_path / "run")]
    refused(["fit", str(renders), *out, "--width", "20"], capfd, "multiple of 4 times the heads")
    refused(["fit", str(renders), *out, "--precision", "int4"], capfd, "precision")
    refused(["lora", str(tmp_path / "none"), str(renders), *out], capfd, "no such file")
    (tmp_path / "text").write_text("no network")
    refused(["lora", str(tmp_path / "text"), str(renders), *out], capfd, "no checkpoint of mini")
    refused(["eval", str(tmp_path), str(renders)], capfd, "manifest")
    refused(["eval", str(mini_bundle), str(tmp_path)], capfd, "There are no renders in")
    assert not (tmp_path / "run").exists()


def test_a_lora_of_no_renders_leaves_nothing(tmp_path, capfd) -> None:
    save_network(Mini(Config(16, 1, 2)), tmp_path / "base.safetensors")
    empty, out = tmp_path / "empty", tmp_path / "run"
    empty.mkdir()
    refused(["lora", str(tmp_path / "base.safetensors"), str(empty), "--out", str(out)], capfd, "no renders")
    assert not out.exists()
