"""LoRAs in every dialect, merged into the weights, against the same LoRA active in diffusers."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tiny_qwen
import torch
from agreement_qwen import RECIPE, call_both
from loras_qwen import DIALECTS, LAYERS, LOADED_BY_DIFFUSERS, write_lora
from peft import LoraConfig, get_peft_model_state_dict
from safetensors.torch import load_file, save_file

from dior_rt.errors import InputError
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.export.qwen.lora import Lora
from dior_rt.export.qwen.weights import Checkpoint, Merged
from dior_rt.families.qwen.model import Qwen


def merged(folder, *loras):
    return Merged(Checkpoint(folder / "transformer"), loras)


@pytest.mark.parametrize("dialect", list(DIALECTS))
@pytest.mark.parametrize("alpha", [None, 2, 4, 16])
def test_every_dialect_means_the_same_change(folders, tmp_path, dialect, alpha):
    path = write_lora(tmp_path / "lora.safetensors", dialect, alpha=alpha)
    weights = merged(folders[True], Lora(path, 0.5))
    tensors = list(load_file(write_lora(tmp_path / "plain.safetensors", "bare")).items())
    pairs = {key.rsplit(".lora", 1)[0]: {} for key, _ in tensors}
    for key, tensor in tensors:
        pairs[key.rsplit(".lora", 1)[0]]["down" if "down" in key else "up"] = tensor
    base = dict(tiny_qwen.transformer().named_parameters())
    for layer in LAYERS:
        scale = 0.5 * (1 if alpha is None else alpha / 4)
        want = base[f"{layer}.weight"].detach() + scale * pairs[layer]["up"] @ pairs[layer]["down"]
        np.testing.assert_allclose(weights[f"{layer}.weight"], want.numpy(), atol=1e-6)
    untouched = "transformer_blocks.0.attn.to_k.weight"
    np.testing.assert_array_equal(weights[untouched], base[untouched].detach().numpy())


@pytest.mark.parametrize(
    "dialect",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name != "diffusers" else [])
        for name in LOADED_BY_DIFFUSERS
    ],
)
def test_a_merged_bundle_computes_what_an_active_lora_does(folders, tmp_path, dialect):
    path = write_lora(tmp_path / "lora.safetensors", dialect, alpha=None if dialect == "diffusers" else 3)
    pipe = tiny_qwen.pipeline()
    plain, _ = call_both_of(folders[True], tmp_path / "plain", pipe, [])
    pipe.load_lora_weights(str(path), adapter_name="light")
    pipe.set_adapters(["light"], [0.8])
    got, want = call_both_of(folders[True], tmp_path / "merged", pipe, [Lora(path, 0.8)])
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()
    assert np.abs(plain - want).max() > 0.05 * np.abs(want).max()


def test_two_loras_with_their_own_strengths_add(folders, tmp_path):
    light = write_lora(tmp_path / "light.safetensors", "diffusers", rank=4)
    fast = write_lora(tmp_path / "fast.safetensors", "bare", rank=2, alpha=1, seed=5, layers=LAYERS[2:6])
    pipe = tiny_qwen.pipeline()
    pipe.load_lora_weights(str(light), adapter_name="light")
    pipe.load_lora_weights(str(fast), adapter_name="fast")
    pipe.set_adapters(["light", "fast"], [1.25, -0.5])
    got, want = call_both_of(folders[True], tmp_path / "both", pipe, [Lora(light, 1.25), Lora(fast, -0.5)])
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def call_both_of(folder, out, pipe, loras):
    qwen = Qwen(export_qwen(folder, out, RECIPE, loras=loras), "cpu")
    return call_both(qwen, pipe, 0.4, 7, [(4, 4), (4, 4), (4, 4)])


def test_alpha_in_the_metadata_is_honoured_as_diffusers_does(folders, tmp_path):
    pipe = tiny_qwen.pipeline()
    config = LoraConfig(
        r=4,
        lora_alpha=10,
        target_modules=["to_q", "img_mlp.net.2"],
        alpha_pattern={"transformer_blocks.1.attn.to_q": 3},
        init_lora_weights="gaussian",
    )
    pipe.transformer.add_adapter(config)
    generator = torch.Generator().manual_seed(0)
    for name, weight in pipe.transformer.named_parameters():
        if "lora_B" in name:
            weight.data = torch.randn(weight.shape, generator=generator) / 4
    pipe.save_lora_weights(
        tmp_path,
        transformer_lora_layers=get_peft_model_state_dict(pipe.transformer),
        transformer_lora_adapter_metadata=config.to_dict(),
    )
    got, want = call_both_of(
        folders[True], tmp_path / "bundle", pipe, [Lora(tmp_path / "pytorch_lora_weights.safetensors")]
    )
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_alpha_beside_a_file_of_peft_is_honoured(folders, tmp_path):
    path = write_lora(tmp_path / "adapter_model.safetensors", "peft", layers=["img_in"])
    plain = merged(folders[True])["img_in.weight"]
    change = merged(folders[True], Lora(path))["img_in.weight"] - plain
    for settings, factor in (({"lora_alpha": 8}, 2.0), ({"lora_alpha": 8, "use_rslora": True}, 4.0)):
        (tmp_path / "adapter_config.json").write_text(json.dumps(settings))
        scaled = merged(folders[True], Lora(path))["img_in.weight"] - plain
        np.testing.assert_allclose(scaled, factor * change, atol=1e-6)


def test_a_lora_of_another_model_is_refused(folders, tmp_path):
    path = tmp_path / "lora.safetensors"
    tensors = {"transformer.blocks.7.to_q.lora_A.weight": torch.ones(2, 48)}
    tensors["transformer.blocks.7.to_q.lora_B.weight"] = torch.ones(48, 2)
    save_file(tensors, path)
    with pytest.raises(InputError, match=r"for another model: 1 of its 1 layers, such as 'blocks\.7\.to_q'"):
        merged(folders[True], Lora(path))


def test_a_lora_of_another_width_is_refused(folders, tmp_path):
    path = tmp_path / "lora.safetensors"
    save_file({"img_in.lora_A.weight": torch.ones(2, 99), "img_in.lora_B.weight": torch.ones(48, 2)}, path)
    with pytest.raises(
        InputError, match=r"its change to 'img_in' is \(48, 2\) x \(2, 99\), the layer \(48, 16\)"
    ):
        merged(folders[True], Lora(path))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (["img_in.lora_A.weight"], "only one of the two matrices for 'img_in'"),
        (
            ["img_in.lora_A.weight", "img_in.lora_B.weight", "img_in.dora_scale"],
            "it holds 'img_in.dora_scale'",
        ),
        (["img_in.hada_w1_a"], "no LoRA that can be merged"),
        (["img_in.lora_A.weight", "transformer.img_in.lora_A.weight"], "changes 'img_in' twice"),
        ([], "holds no LoRA"),
    ],
)
def test_what_is_no_plain_lora_is_refused(tmp_path, keys, message):
    path = tmp_path / "lora.safetensors"
    save_file({key: torch.ones(2, 2) for key in keys}, path)
    with pytest.raises(InputError, match=message):
        Lora(path)


def test_dora_by_its_settings_is_refused(tmp_path):
    settings = json.dumps({"transformer.use_dora": True})
    path = write_lora(
        tmp_path / "lora.safetensors", "diffusers", metadata={"lora_adapter_metadata": settings}
    )
    with pytest.raises(InputError, match="it uses DoRA or biases"):
        Lora(path)


def test_a_lora_that_is_missing_cut_short_or_damaged_is_refused(folders, tmp_path):
    with pytest.raises(InputError, match="is missing, cut short"):
        Lora(tmp_path / "none.safetensors")
    path = write_lora(tmp_path / "lora.safetensors", "diffusers")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="is missing, cut short"):
        Lora(path)
    save_file(
        {"img_in.lora_A.weight": torch.full((2, 16), torch.nan), "img_in.lora_B.weight": torch.ones(48, 2)},
        path,
    )
    with pytest.raises(InputError, match="its change to 'img_in' is not finite"):
        merged(folders[True], Lora(path))["img_in.weight"]


@pytest.mark.parametrize("strength", [float("nan"), float("inf")])
def test_a_strength_that_is_no_number_is_refused(tmp_path, strength):
    path = write_lora(tmp_path / "lora.safetensors", "diffusers")
    with pytest.raises(InputError, match="cannot be merged with a strength"):
        Lora(path, strength)
