"""The settings of a Qwen bundle beyond the manifest: the file qwen.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dior_rt.bundle import Bundle
from dior_rt.errors import BundleError
from dior_rt.records import parse, read_json

FILE: Final = "qwen.json"
MODULATION: Final = "modulation.npy"
PROMPTS: Final = "prompts.npz"
MOST_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class VisionSettings:
    """How a picture becomes patches for the vision tower, and their positions."""

    area: int
    multiple: int
    least_pixels: int
    most_pixels: int
    mean: tuple[float, ...]
    std: tuple[float, ...]
    patch: int
    frames: int
    merge: int
    window: int
    whole_blocks: tuple[int, ...]
    blocks: int
    head: int
    theta: float


@dataclass(frozen=True)
class TextSettings:
    """The language model, and the prompts as word ids: rows of `prompts.npz`.

    picture_id: the word that represents one feature of a picture; each prompt contains it once per picture.
    skip: words at the start of the template whose embeddings are dropped.
    """

    prompts: dict[str, tuple[int, ...]]
    picture_id: int
    skip: int
    blocks: int
    head: int
    theta: float
    sections: tuple[int, ...]
    vision: VisionSettings


@dataclass(frozen=True)
class QwenSettings:
    """The model's sizes.

    area, multiple: the rule for the size of pictures, in pixels.
    factor: pixels per latent; patch: latents per token, in each direction.
    axes: how many of a head's numbers rotate with frame, row and column.
    reference_at_zero: reference pictures are modulated as at sigma = 0.
    fixed_sigmas: the only schedule for which the bundle has modulation; empty if it can compute any.
    lumi_peak: the light that is shown as white.
    text: None if `prompts.npz` holds the prompts' embeddings.
    """

    area: int
    multiple: int
    factor: int
    patch: int
    layers: int
    axes: tuple[int, ...]
    theta: float
    reference_at_zero: bool
    fixed_sigmas: tuple[float, ...]
    lumi_peak: float
    text: TextSettings | None

    def __post_init__(self) -> None:
        if min(self.area, self.multiple, self.factor, self.patch, self.layers) < 1 or not self.axes:
            raise ValueError("sizes must be positive")
        if self.multiple % (self.factor * self.patch):
            raise ValueError("multiple must hold whole tokens")


def read_settings(bundle: Bundle) -> QwenSettings:
    """Read qwen.json. Raises BundleError if it is missing or wrong."""
    path: Path = bundle.folder / FILE
    try:
        return parse(QwenSettings, read_json(path, MOST_BYTES))
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot read {path}: {error}.") from error
