"""Merging a LoRA: the merged network computes what the adapted one does, and strange adapters are refused."""

import copy

import numpy as np
import pytest
import torch
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file

from dior_rt.errors import InputError
from dior_rt.export.check import evaluate, random_feeds, relative_error
from dior_rt.export.lora import merge_lora

FEEDS = random_feeds(8, 12, seed=0)


@pytest.fixture
def adapted(network):
    torch.manual_seed(1)
    config = LoraConfig(r=4, lora_alpha=6, target_modules=["qkv", "up"])
    model = get_peft_model(copy.deepcopy(network), config)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.3)
    return model.eval()


@pytest.fixture
def folder(adapted, tmp_path):
    adapted.save_pretrained(tmp_path / "lora")
    return tmp_path / "lora"


def test_merged_equals_unmerged(network, adapted, folder):
    base, want = evaluate(network, FEEDS), evaluate(adapted, FEEDS)
    merged = merge_lora(network, folder)
    assert relative_error(base, want) > 1e-3
    assert relative_error(evaluate(merged, FEEDS), want) < 1e-5
    assert not any("lora" in name for name, _ in merged.named_parameters())


def test_the_change_is_alpha_over_rank_b_a(network, folder):
    weights = load_file(folder / "adapter_model.safetensors")
    before = network.blocks[0].qkv.weight.detach().clone()
    after = merge_lora(network, folder).blocks[0].qkv.weight.detach()
    a, b = (weights[f"base_model.model.blocks.0.qkv.lora_{part}.weight"] for part in "AB")
    np.testing.assert_allclose(after - before, 6 / 4 * b @ a, atol=1e-6)


@pytest.mark.parametrize(
    "damage", ["no folder", "no weights", "cut", "a pickle", "no config", "lacks", "more"]
)
def test_an_adapter_that_does_not_fit_is_refused(network, folder, damage):
    path = folder / "adapter_model.safetensors"
    weights = {name: weight.clone() for name, weight in load_file(path).items()}  # not mapped from the file
    first = sorted(weights)[0]
    match damage:
        case "no folder":
            folder = folder / "nowhere"
        case "no weights":
            path.unlink()
        case "cut":
            path.write_bytes(path.read_bytes()[:-10])
        case "a pickle":
            path.unlink()
            torch.save(weights, folder / "adapter_model.bin")
        case "no config":
            (folder / "adapter_config.json").unlink()
        case "lacks":
            save_file({name: weight for name, weight in weights.items() if name != first}, path)
        case "more":
            save_file(
                {**weights, "base_model.model.blocks.9.qkv.lora_A.weight": weights[first].clone()}, path
            )
    with pytest.raises(InputError, match="LoRA") as refusal:
        merge_lora(network, folder)
    assert "\n" not in str(refusal.value)
