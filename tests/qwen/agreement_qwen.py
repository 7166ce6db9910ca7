"""How the tiny bundles are made, and one call of the transformer by diffusers and by a bundle."""

from __future__ import annotations

import numpy as np
import torch

from dior_rt.export.qwen.bundle import QwenExportConfig
from dior_rt.families.qwen.frame import Frame
from dior_rt.families.qwen.model import Condition
from dior_rt.families.qwen.template import Prompts

AREA, VISION_AREA = 96 * 96, 64 * 64
RECIPE = QwenExportConfig(
    free_steps=True,
    area=AREA,
    vision_area=VISION_AREA,
    probe_area=64 * 64,
    prompts=Prompts(relight="light it from the left", estimate="draw its light"),
)


def call_both(qwen, pipe, sigma, words, sizes, seed=0, mask=False):
    """The velocity of random latents, by diffusers and by the bundle."""
    random = np.random.default_rng(seed)
    counts = [rows * columns for rows, columns in sizes]
    x, references = (random.standard_normal((n, 16), dtype=np.float32) for n in (counts[0], sum(counts[1:])))
    text = random.standard_normal((words, 32), dtype=np.float32)
    with torch.no_grad():
        want = pipe.transformer(
            torch.from_numpy(np.concatenate([x, references]))[None],
            torch.from_numpy(text)[None],
            torch.ones(1, words) if mask else None,
            torch.tensor([sigma]),
            [[(1, *size) for size in sizes]],
            return_dict=False,
        )[0]
    frame = Frame.around((32, 32), 32)
    condition = Condition("relight", (32, 32), frame, references, tuple(sizes), ())
    modulation = qwen.modulation(np.array([sigma], np.float32))
    got = qwen.predict(x, condition, [text], modulation)[0]
    return got, want[0, : counts[0]].numpy()
