"""Measure the error of an export: each block against torch, and a bundle against its float32 twin."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from diffusers.models.transformers.transformer_qwenimage import QwenImageTransformerBlock
from numpy.typing import NDArray

from dior_rt.bundle import Bundle
from dior_rt.engine import Engine
from dior_rt.export.check import ExportError
from dior_rt.export.qwen.graph import Precision
from dior_rt.export.qwen.transformer import THETA, TransformerConfig
from dior_rt.export.qwen.weights import Weights
from dior_rt.families.qwen.model import Qwen
from dior_rt.families.qwen.rope import joint_places, turns
from dior_rt.flow.sampler import Array, draw_noise, sample
from dior_rt.kernels import Strokes

BLOCK_BAR: Final[dict[Precision, float]] = {
    "fp32": 1e-4,
    "fp16": 5e-3,
    "int8": 0.1,
    "int4": 0.5,
}  # largest relative error of a block
WORDS: Final = 5
MEMORY: Final = 4 << 30  # bytes of weights that stay loaded while a bundle is measured
SIZES: Final = ((4, 6), (4, 6), (4, 6))


def check_block(
    path: Path, config: TransformerConfig, weights: Weights, index: int, precision: Precision
) -> float:
    """Return the error of a block's graph against diffusers' block with the same weights.

    The error is relative to the change that the block makes to its inputs. Raises ExportError above
    BLOCK_BAR.
    """
    block = load_block(config, weights, index)
    feeds, inputs = block_inputs(config, block, seed=index, words=WORDS, sizes=SIZES)
    want = run_block(block, inputs)
    made = Engine(path).run(feeds)
    before = np.concatenate([feeds["text"], feeds["image"]])
    got = np.concatenate([made["text_out"], made["image_out"]])
    error = float(np.linalg.norm(got - want) / np.linalg.norm(want - before))
    if not error <= BLOCK_BAR[precision]:
        raise ExportError(
            f"Block {index} differs from diffusers by {error:.2g} of what it computes; "
            f"{BLOCK_BAR[precision]:g} is allowed in {precision}."
        )
    return error


def load_block(config: TransformerConfig, weights: Weights, index: int) -> QwenImageTransformerBlock:
    """Return one of diffusers' blocks with its weights and merged LoRAs. Nothing else is read."""
    block = empty_block(config)
    load_weights(block, f"transformer_blocks.{index}.", weights)
    return block


def load_weights(module: torch.nn.Module, at: str, weights: Weights) -> None:
    """Fill a module without memory with the tensors whose names start with `at`."""
    state = {name: torch.from_numpy(weights[at + name]) for name in module.state_dict()}
    module.load_state_dict(state, assign=True)
    module.eval()


def empty_block(config: TransformerConfig) -> QwenImageTransformerBlock:
    """Return one of diffusers' blocks with shapes but no memory."""
    heads, width = config.num_attention_heads, config.attention_head_dim
    with torch.device("meta"):
        return QwenImageTransformerBlock(config.width, heads, width, zero_cond_t=config.zero_cond_t)


def block_inputs(
    config: TransformerConfig,
    block: QwenImageTransformerBlock,
    *,
    seed: int,
    words: int,
    sizes: tuple[tuple[int, int], ...],
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return random inputs of a block, for its graph and for diffusers. sizes: of the pictures, in tokens."""
    counts = [rows * columns for rows, columns in sizes]
    random = np.random.default_rng(seed)
    image, text, embedding = (
        random.standard_normal((rows, config.width), dtype=np.float32)
        for rows in (sum(counts), words, 1 + config.zero_cond_t)
    )
    cos, sin = turns(joint_places(words, sizes), config.axes_dims_rope, THETA)
    time = torch.from_numpy(embedding)
    with torch.no_grad():
        image_rows = block.img_mod(time).reshape(-1, 6, config.width).numpy()
        text_rows = block.txt_mod(time[:1]).reshape(6, config.width).numpy()
    feeds = {
        "image": image,
        "text": text,
        "cos": cos,
        "sin": sin,
        "image_modulation": image_rows if config.zero_cond_t else image_rows[0],
        "text_modulation": text_rows,
    }
    if config.zero_cond_t:
        feeds["lengths"] = np.array([counts[0], sum(counts[1:])])
    turned = torch.complex(torch.from_numpy(cos), torch.from_numpy(sin))
    inputs = {
        "hidden_states": torch.from_numpy(image)[None],
        "encoder_hidden_states": torch.from_numpy(text)[None],
        "encoder_hidden_states_mask": None,
        "temb": time,
        "image_rotary_emb": (turned[words:], turned[:words]),
        "modulate_index": torch.tensor([[0] * counts[0] + [1] * sum(counts[1:])])
        if config.zero_cond_t
        else None,
    }
    return feeds, inputs


def run_block(block: QwenImageTransformerBlock, inputs: dict[str, Any]) -> Array:
    """Return the output of diffusers' block: text and image, concatenated."""
    with torch.inference_mode():
        text, image = block(**inputs)
    return np.concatenate([text[0].numpy(), image[0].numpy()])


def compare(bundle: Bundle, reference: Bundle, area: int) -> dict[str, float]:
    """Return the error of a bundle against its float32 twin, on one picture of `area` pixels.

    one_step, all_steps: the relative error of the first guided velocity, and of the state at the end.
    picture_db: the PSNR between the two pictures.
    """
    paths = [_trace(one, area) for one in (bundle, reference)]
    first, last, picture = ((a, b) for a, b in zip(*paths, strict=True))
    return {
        "one_step": relative(*first),
        "all_steps": relative(*last),
        "picture_db": psnr(*picture),
    }


def _trace(bundle: Bundle, area: int) -> tuple[Array, Array, Array]:
    """Return the first velocity, the last state and the picture of a run with a fixed photo and strokes."""
    qwen, manifest = Qwen(bundle, "cpu", memory=MEMORY, area=area), bundle.manifest
    side = round(math.sqrt(area))
    raster = qwen.raster(side, side)
    condition = qwen.encode(probe_photo(raster), probe_strokes(raster), "relight")
    sigmas = qwen.sigmas(manifest.steps, condition)
    velocity = qwen.velocity(condition, sigmas, manifest.guidance)
    noise = draw_noise(0, qwen.noise_shape(condition))
    first = velocity(noise, float(sigmas[0]))
    *_, end = sample(velocity, noise, sigmas)
    return first, end.x, qwen.decode_relit(end.x, condition)


def probe_photo(size: tuple[int, int]) -> Array:
    """Return a smooth picture (h, w, 3) with an edge, sRGB 0..1."""
    y, x = np.mgrid[: size[0], : size[1]] / max(size)
    waves = [0.5 + 0.4 * np.sin(7 * x + 3 * y), 0.3 + 0.5 * (x > y), np.sqrt((x + y) / 2)]
    return np.stack(waves, axis=-1).clip(0, 1).astype(np.float32)


def probe_strokes(size: tuple[int, int]) -> Strokes:
    """Return strokes with a warm spot and a dark one."""
    y, x = np.mgrid[: size[0], : size[1]] / max(size)
    light = np.zeros((*size, 3), np.float32)
    light[np.hypot(x - 0.3, y - 0.3) < 0.1] = (1.5, 1.0, 0.6)
    mask = (np.hypot(x - 0.3, y - 0.3) < 0.1) | (np.hypot(x - 0.7, y - 0.6) < 0.1)
    return Strokes(light, mask.astype(np.float32))


def relative(got: Array, want: Array) -> float:
    """Return |got - want| / |want|."""
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


def psnr(got: Array, want: Array) -> float:
    """Return the peak signal-to-noise ratio of pictures 0..1, in dB."""
    return float(-10 * np.log10(max(np.mean(np.square(got - want, dtype=np.float64)), 1e-20)))
