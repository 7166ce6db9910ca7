"""What is said to Qwen-Image-Edit: the prompt of each mode, and the words around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# The words around every prompt that the model was trained with; the embeddings of the first 64 are dropped.
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
    """What is said to the model in each mode; relight shows it two pictures, estimate one."""

    relight: str = (
        "Relight Picture 1 with the light that is drawn in Picture 2. Keep the viewpoint, the shapes, the "
        "materials and the people. Where Picture 2 is black, the light is free."
    )
    estimate: str = "Draw the light that falls on every surface of Picture 1, as if all were white and matte."
    negative: str = " "

    def each(self) -> dict[str, tuple[str, int]]:
        """By the name that the runtime uses: the words, and how many pictures come with them."""
        return {
            "relight": (self.relight, 2),
            "relight_negative": (self.negative, 2),
            "estimate": (self.estimate, 1),
            "estimate_negative": (self.negative, 1),
        }
