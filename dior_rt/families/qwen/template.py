"""The prompts of Qwen-Image-Edit: one per mode, and the template around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# The template of every prompt in the model's training. The embeddings of its first 64 words are dropped.
TEMPLATE: Final = (
    "<|im_start|>system\n"
    "Describe the key features of the input image (color, shape, size, texture, objects, background), then "
    "explain how the user's text instruction should alter or modify the image. Generate a new image that "
    "meets the user's requirements while maintaining consistency with the original input where appropriate."
    "<|im_end|>\n<|im_start|>user\n{}<|im_end|>\n<|im_start|>assistant\n"
)
SKIP: Final = 64
PICTURE: Final = "Picture {}: <|vision_start|><|image_pad|><|vision_end|>"


@dataclass(frozen=True)
class Prompts:
    """The prompt of each mode. relight shows the model two pictures, estimate one."""

    relight: str = (
        "Relight Picture 1 with the light that is drawn in Picture 2. Keep the viewpoint, the shapes, the "
        "materials and the people. Where Picture 2 is black, the light is free."
    )
    estimate: str = "Draw the light that falls on every surface of Picture 1, as if all were white and matte."
    negative: str = " "

    def each(self) -> dict[str, tuple[str, int]]:
        """Return, by the name in the runtime, the prompt and its number of pictures."""
        return {
            "relight": (self.relight, 2),
            "relight_negative": (self.negative, 2),
            "estimate": (self.estimate, 1),
            "estimate_negative": (self.negative, 1),
        }
