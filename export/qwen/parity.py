"""Compare the autoencoder and the text encoder's layers with diffusers and transformers.

Each part is built by its own library with the same weights, while nothing else is in memory. The export fails
above a bar; the figures go into the manifest. `errors.check_block` does the same for the transformer's
blocks.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from diffusers import AutoencoderKLQwenImage
from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import Qwen2_5_VLDecoderLayer, Qwen2_5_VLVisionBlock

from dior_rt.engine import Engine, Feeds
from dior_rt.export.check import ExportError
from dior_rt.export.qwen.errors import BLOCK_BAR, load_weights
from dior_rt.export.qwen.graph import Precision
from dior_rt.export.qwen.text import TextConfig
from dior_rt.export.qwen.weights import Checkpoint, Weights, read_config
from dior_rt.flow.sampler import Array

VAE_BAR: Final = 1e-4  # largest error, relative to the largest value
PICTURE: Final = (64, 96)
WORDS: Final = 7
PATCHES: Final = (8, 12)  # the size of two windows


def check_vae(folder: Path, config: Path, weights: Checkpoint) -> dict[str, float]:
    """Return the errors of encoder.onnx and decoder.onnx in `folder`, relative to the largest value.

    config: the autoencoder's config.json. Raises ExportError above VAE_BAR.
    """
    with torch.device("meta"):
        vae: Any = AutoencoderKLQwenImage.from_config(read_config(config))
    load_weights(vae, "", weights)
    mean, std = (
        torch.tensor(values).reshape(1, -1, 1, 1)
        for values in (vae.config.latents_mean, vae.config.latents_std)
    )
    random = np.random.default_rng(0)
    pixels = random.uniform(-1, 1, (1, 3, *PICTURE)).astype(np.float32)
    with torch.inference_mode():
        latents = (vae.encode(torch.from_numpy(pixels)[:, :, None]).latent_dist.mode()[:, :, 0] - mean) / std
        painted = vae.decode((latents * std + mean)[:, :, None]).sample[:, :, 0]
    encoded = Engine(folder / "encoder.onnx").run({"pixels": pixels})["latents"]
    decoded = Engine(folder / "decoder.onnx").run({"latents": latents.numpy()})["pixels"]
    errors = {
        "vae_encoder": _largest(encoded, latents.numpy()),
        "vae_decoder": _largest(decoded, painted.numpy()),
    }
    for part, error in errors.items():
        if not error <= VAE_BAR:
            raise ExportError(
                f"The {part} is off by {error:.2g} of its largest value; {VAE_BAR:g} is allowed."
            )
    return errors


def check_text_layer(
    path: Path, config: TextConfig, weights: Weights, name: str, precision: Precision
) -> float | None:
    """Return the error of the graph text.block.NN or vision.block.NN, relative to what the layer changes.

    Return None for the other graphs of the encoder. Raises ExportError above BLOCK_BAR.
    """
    kind, _, index = name.rpartition(".")
    if kind == "text.block":
        feeds, want = _text_block(config, weights, int(index))
    elif kind == "vision.block":
        feeds, want = _vision_block(config, weights, int(index))
    else:
        return None
    got = Engine(path).run(feeds)["out"]
    error = float(np.linalg.norm(got - want) / np.linalg.norm(want - feeds["x"]))
    if not error <= BLOCK_BAR[precision]:
        raise ExportError(
            f"The layer {name} of the text encoder differs from transformers by {error:.2g} of what it "
            f"computes; {BLOCK_BAR[precision]:g} is allowed in {precision}."
        )
    return error


def _text_block(config: TextConfig, weights: Weights, index: int) -> tuple[Feeds, Array]:
    text = _plain_attention(config.text)
    with torch.device("meta"):
        layer = Qwen2_5_VLDecoderLayer(text, index)
    load_weights(layer, f"model.layers.{index}.", weights)
    feeds, turned = _inputs(WORDS, text.hidden_size, text.hidden_size // text.num_attention_heads, index)
    later = torch.full((1, 1, WORDS, WORDS), -torch.inf).triu(1)
    turned = tuple(part[None] for part in turned)
    with torch.inference_mode():
        out = layer(torch.from_numpy(feeds["x"])[None], attention_mask=later, position_embeddings=turned)
    return feeds, out[0].numpy()


def _vision_block(config: TextConfig, weights: Weights, index: int) -> tuple[Feeds, Array]:
    vision = _plain_attention(config.vision)
    with torch.device("meta"):
        block = Qwen2_5_VLVisionBlock(vision)
    load_weights(block, f"visual.blocks.{index}.", weights)
    feeds, turned = _inputs(sum(PATCHES), vision.hidden_size, vision.hidden_size // vision.num_heads, index)
    ends = torch.tensor([0, *np.cumsum(PATCHES).tolist()])
    with torch.inference_mode():
        out = block(torch.from_numpy(feeds["x"]), cu_seqlens=ends, position_embeddings=turned)
    return {**feeds, "groups": np.repeat(np.arange(len(PATCHES)), PATCHES)}, out.numpy()


def _inputs(rows: int, width: int, head: int, seed: int) -> tuple[dict[str, Array], tuple[torch.Tensor, ...]]:
    """Return random x and rotary positions, for the graph and for transformers."""
    random = np.random.default_rng(seed)
    x = random.standard_normal((rows, width), dtype=np.float32)
    angles = random.uniform(0, 6, (rows, head // 2)).astype(np.float32)
    feeds = {"x": x, "cos": np.cos(angles), "sin": np.sin(angles)}
    return feeds, tuple(torch.from_numpy(np.concatenate([feeds[n]] * 2, axis=1)) for n in ("cos", "sin"))


def _plain_attention(config: Any) -> Any:
    """Return the same settings, but without fused kernels."""
    plain = copy(config)
    plain._attn_implementation = "eager"
    return plain


def _largest(got: Array, want: Array) -> float:
    return float(np.abs(got - want).max() / np.abs(want).max())
