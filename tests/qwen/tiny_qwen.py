"""A complete diffusers folder of Qwen-Image-Edit in miniature: the same classes and keys, random weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import (
    AutoencoderKLQwenImage,
    FlowMatchEulerDiscreteScheduler,
    QwenImageEditPlusPipeline,
    QwenImageTransformer2DModel,
)
from PIL import Image
from tokenizers.pre_tokenizers import ByteLevel
from transformers import (
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen2Tokenizer,
    Qwen2VLProcessor,
)
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

SPECIAL_TOKENS = (
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|vision_pad|>",
    "<|image_pad|>",
    "<|video_pad|>",
)

# scheduler/scheduler_config.json of Qwen-Image-Edit-2511.
SCHEDULER = {
    "base_image_seq_len": 256,
    "base_shift": 0.5,
    "max_image_seq_len": 8192,
    "max_shift": 0.9,
    "shift_terminal": 0.02,
    "time_shift_type": "exponential",
    "use_dynamic_shifting": True,
}


class ImageHalfProcessor(Qwen2VLProcessor):
    """The processor without its video half, which asks for torchvision."""

    def __init__(self, image_processor: Qwen2VLImageProcessorPil, tokenizer: Qwen2Tokenizer) -> None:
        super().__init__(image_processor, tokenizer)

    @classmethod
    def get_attributes(cls) -> list[str]:
        return ["image_processor", "tokenizer"]


def randomize(module: torch.nn.Module, seed: int, gain: float = 1.0) -> None:
    """Fill a module with weights of unit gain (matrices by fan-in, scales near 1, biases near 0)."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in module.named_parameters():
            noise = torch.randn(weight.shape, generator=generator)
            if weight.squeeze().ndim > 1:
                weight.copy_(noise * gain / weight[0].numel() ** 0.5)
            elif name.endswith("bias"):
                weight.copy_(noise * 0.1)
            else:  # the scale of a norm
                weight.copy_(1 + noise * 0.1)


def tokenizer() -> Qwen2Tokenizer:
    """Byte-level BPE without merges: 256 letters and the special tokens."""
    words = [*sorted(ByteLevel.alphabet()), *SPECIAL_TOKENS]
    made = Qwen2Tokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[])
    made.add_special_tokens({"additional_special_tokens": list(SPECIAL_TOKENS)})
    return made


def text_encoder(seed: int = 1) -> Qwen2_5_VLForConditionalGeneration:
    config = Qwen2_5_VLConfig(
        text_config={
            "vocab_size": 256 + len(SPECIAL_TOKENS),
            "hidden_size": 32,
            "intermediate_size": 48,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "rms_norm_eps": 1e-6,
            "rope_parameters": {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [1, 1, 2]},
            "bos_token_id": 256,
            "eos_token_id": 258,
        },
        vision_config={
            "depth": 2,
            "hidden_size": 32,
            "intermediate_size": 40,
            "num_heads": 2,
            "out_hidden_size": 32,
            "fullatt_block_indexes": [1],
        },
        image_token_id=256 + SPECIAL_TOKENS.index("<|image_pad|>"),
        video_token_id=256 + SPECIAL_TOKENS.index("<|video_pad|>"),
        vision_start_token_id=256 + SPECIAL_TOKENS.index("<|vision_start|>"),
        vision_end_token_id=256 + SPECIAL_TOKENS.index("<|vision_end|>"),
    )
    model = Qwen2_5_VLForConditionalGeneration(config).eval()
    randomize(model, seed)
    return model


def transformer(seed: int = 2, *, layers: int = 3, zero_cond_t: bool = True) -> QwenImageTransformer2DModel:
    model = QwenImageTransformer2DModel(
        in_channels=16,
        out_channels=4,
        num_layers=layers,
        num_attention_heads=3,
        attention_head_dim=16,
        joint_attention_dim=32,
        axes_dims_rope=(4, 6, 6),
        zero_cond_t=zero_cond_t,
    ).eval()
    randomize(model, seed)
    return model


def vae(seed: int = 3) -> AutoencoderKLQwenImage:
    model = AutoencoderKLQwenImage(
        base_dim=24,
        z_dim=4,
        latents_mean=[-0.7571, -0.7089, 0.1075, 0.9653],
        latents_std=[2.8184, 1.4541, 1.2196, 1.7708],
    ).eval()
    randomize(model, seed)
    return model


def pipeline(
    *, zero_cond_t: bool = True, scheduler: dict[str, object] | None = None
) -> QwenImageEditPlusPipeline:
    words = tokenizer()
    pipe = QwenImageEditPlusPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(**(scheduler or SCHEDULER)),
        vae=vae(),
        text_encoder=text_encoder(),
        tokenizer=words,
        processor=ImageHalfProcessor(Qwen2VLImageProcessorPil(), words),
        transformer=transformer(zero_cond_t=zero_cond_t),
    )
    pipe.set_progress_bar_config(disable=True)
    pipe.text_encoder.register_forward_pre_hook(_tell_pictures_from_words, with_kwargs=True)
    return pipe


def _tell_pictures_from_words(encoder: Any, args: Any, kwargs: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Pass on which tokens are pictures.

    diffusers drops it, and transformers from 5 on then places a picture's tokens in a row, like words, where
    the model was trained to place them in a grid: https://github.com/huggingface/diffusers/issues/14194.
    """
    kwargs["mm_token_type_ids"] = (kwargs["input_ids"] == encoder.config.image_token_id).int()
    return args, kwargs


def save(pipe: QwenImageEditPlusPipeline, folder: Path, *, shard: str = "60KB") -> Path:
    """Write the pipeline as diffusers lays it out, the transformer cut into several shards."""
    pipe.transformer.save_pretrained(folder / "transformer", max_shard_size=shard)
    pipe.vae.save_pretrained(folder / "vae")
    pipe.text_encoder.save_pretrained(folder / "text_encoder")
    pipe.scheduler.save_pretrained(folder / "scheduler")
    pipe.tokenizer.save_pretrained(folder / "tokenizer")
    pipe.processor.image_processor.save_pretrained(folder / "processor")
    classes = {name: ["diffusers", type(part).__name__] for name, part in pipe.components.items()}
    (folder / "model_index.json").write_text(json.dumps({"_class_name": type(pipe).__name__, **classes}))
    return folder


def picture(width: int, height: int, seed: int = 0) -> Image.Image:
    """A smooth random picture."""
    small = np.random.default_rng(seed).integers(0, 256, (5, 6, 3), dtype=np.uint8)
    return Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC)
