"""Random LoRA files for the tiny model, in every dialect."""

from __future__ import annotations

import tiny_qwen
import torch
from safetensors.torch import save_file

LAYERS = (
    "transformer_blocks.0.attn.to_q",
    "transformer_blocks.1.attn.add_k_proj",
    "transformer_blocks.1.attn.to_out.0",
    "transformer_blocks.2.attn.to_add_out",
    "transformer_blocks.2.img_mlp.net.0.proj",
    "transformer_blocks.0.txt_mlp.net.2",
    "transformer_blocks.1.img_mod.1",
    "img_in",
    "proj_out",
)
DIALECTS = {
    "diffusers": ("transformer.{}", "lora_A.weight", "lora_B.weight"),
    "peft": ("base_model.model.{}", "lora_A.default.weight", "lora_B.default.weight"),
    "comfy": ("diffusion_model.{}", "lora_down.weight", "lora_up.weight"),
    "bare": ("{}", "lora_down.weight", "lora_up.weight"),
    "kohya": ("lora_unet_{}", "lora_down.weight", "lora_up.weight"),
}
# What diffusers' loader takes; peft's own file it does not.
LOADED_BY_DIFFUSERS = ("diffusers", "comfy", "bare", "kohya")


def write_lora(path, dialect, *, rank=4, alpha=None, layers=LAYERS, seed=0, metadata=None):
    """A random LoRA file; alpha: None leaves the tensors of alpha out."""
    weights = dict(tiny_qwen.transformer().named_parameters())
    generator = torch.Generator().manual_seed(seed)
    name, down, up = DIALECTS[dialect]
    tensors = {}
    for layer in layers:
        rows, columns = weights[f"{layer}.weight"].shape
        at = name.format(layer.replace(".", "_") if dialect == "kohya" else layer)
        tensors[f"{at}.{down}"] = torch.randn(rank, columns, generator=generator) / columns**0.5
        tensors[f"{at}.{up}"] = torch.randn(rows, rank, generator=generator) / 2
        if alpha is not None:
            tensors[f"{at}.alpha"] = torch.tensor(float(alpha))
    save_file(tensors, path, metadata)
    return path
