"""Read a diffusers folder of Qwen-Image-Edit, as far as the export needs it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from transformers import Qwen2Tokenizer

from dior_rt.errors import InputError
from dior_rt.export.qwen.lora import Lora
from dior_rt.export.qwen.text import TextConfig
from dior_rt.export.qwen.transformer import TransformerConfig
from dior_rt.export.qwen.vae import VaeConfig, vae_names
from dior_rt.export.qwen.weights import Checkpoint, Merged, read_config
from dior_rt.families.qwen.settings import TextSettings, VisionSettings
from dior_rt.families.qwen.template import PICTURE, SKIP, TEMPLATE
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule

MULTIPLE: Final = 32


@dataclass(frozen=True)
class Files:
    """Safetensors files with all weights of a part, used in place of those in the folder."""

    transformer: Path | None = None
    vae: Path | None = None
    text_encoder: Path | None = None


IN_FOLDER: Final = Files()


class Sources:
    """The parts of a model: a diffusers folder, and optionally weights in other files."""

    def __init__(self, folder: Path, loras: Sequence[Lora] = (), files: Files = IN_FOLDER) -> None:
        """Open the folder. Raises InputError if it is no such model, or if a LoRA does not fit it."""
        if not folder.is_dir():
            raise InputError(f"There is no model folder at {folder}.")
        self.folder = folder
        self.transformer = TransformerConfig.read(folder / "transformer" / "config.json")
        self.transformer_base = Checkpoint(files.transformer or folder / "transformer")
        self.transformer_weights = Merged(self.transformer_base, loras)
        self.vae_config = folder / "vae" / "config.json"
        self.vae = VaeConfig.read(self.vae_config)
        self.vae_weights = Checkpoint(files.vae or folder / "vae", vae_names)
        self._text_file = files.text_encoder or folder / "text_encoder"

    @cached_property
    def text(self) -> TextConfig:
        return TextConfig.read(self.folder / "text_encoder")

    @cached_property
    def text_weights(self) -> Checkpoint:
        return Checkpoint(self._text_file)

    def schedule(self) -> ShiftSchedule | DynamicShiftSchedule:
        """Return the schedule. Raises InputError if the runtime does not have it."""
        path = self.folder / "scheduler" / "scheduler_config.json"
        found = read_config(path)
        strange = [f"use_{kind}_sigmas" for kind in ("karras", "exponential", "beta")] + ["invert_sigmas"]
        if (
            any(found.get(name) for name in strange)
            or found.get("time_shift_type", "exponential") != "exponential"
        ):
            raise InputError(f"{path} uses a schedule that this export does not support.")
        try:
            return _schedule(found)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} describes no schedule that this export supports: {error}.") from error

    def text_settings(self, prompts: dict[str, tuple[int, ...]], vision_area: int) -> TextSettings:
        """Return the settings that the runtime needs to run the text encoder on these prompts."""
        text, vision = self.text.text, self.text.vision
        seen = read_config(self.folder / "processor" / "preprocessor_config.json")
        limits: Any = seen.get("size", {})
        return TextSettings(
            prompts=prompts,
            picture_id=self._picture_id(),
            skip=SKIP,
            blocks=text.num_hidden_layers,
            head=text.hidden_size // text.num_attention_heads,
            theta=float(text.rope_parameters["rope_theta"]),
            sections=tuple(text.rope_parameters["mrope_section"]),
            vision=VisionSettings(
                area=vision_area,
                multiple=MULTIPLE,
                least_pixels=int(seen.get("min_pixels") or limits["shortest_edge"]),
                most_pixels=int(seen.get("max_pixels") or limits["longest_edge"]),
                mean=tuple(seen["image_mean"]),  # type: ignore[arg-type]
                std=tuple(seen["image_std"]),  # type: ignore[arg-type]
                patch=vision.patch_size,
                frames=vision.temporal_patch_size,
                merge=vision.spatial_merge_size,
                window=vision.window_size,
                whole_blocks=tuple(vision.fullatt_block_indexes),
                blocks=vision.depth,
                head=vision.hidden_size // vision.num_heads,
                theta=float(vision.rope_parameters["rope_theta"]),
            ),
        )

    @cached_property
    def _tokenizer(self) -> Qwen2Tokenizer:
        try:
            return Qwen2Tokenizer.from_pretrained(self.folder / "tokenizer", local_files_only=True)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"Cannot read the tokenizer of {self.folder}: {str(error).splitlines()[0]}"
            ) from error

    def _picture_id(self) -> int:
        word: Any = self._tokenizer.convert_tokens_to_ids("<|image_pad|>")
        if word is None:
            raise InputError(f"The tokenizer of {self.folder} does not know the word for a picture.")
        return int(word)

    def word_ids(self, prompt: str, pictures: int) -> tuple[int, ...]:
        """Return the word ids of a prompt in its template, with room for that many pictures."""
        words = "".join(PICTURE.format(k + 1) for k in range(pictures)) + prompt
        ids = tuple(self._tokenizer(TEMPLATE.format(words))["input_ids"])
        if ids.count(self._picture_id()) != pictures:
            raise InputError(f"The tokenizer of {self.folder} does not know the word for a picture.")
        return ids


def _schedule(found: dict[str, Any]) -> ShiftSchedule | DynamicShiftSchedule:
    if not found.get("use_dynamic_shifting"):
        return ShiftSchedule(float(found["shift"]))
    base, most = float(found["base_shift"]), float(found["max_shift"])
    if found.get("shift_terminal") is None and base == most:
        return ShiftSchedule(math.exp(base))
    return DynamicShiftSchedule(
        base,
        most,
        int(found["base_image_seq_len"]),
        int(found["max_image_seq_len"]),
        float(found["shift_terminal"]),
    )
