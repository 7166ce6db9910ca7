"""Read LoRA files: which layers they change, and by how much.

A file may name a layer as diffusers does (transformer.<layer>.lora_A.weight), as peft does
(base_model.model.<layer>.lora_A.default.weight), as ComfyUI does (diffusion_model.<layer>.lora_down.weight)
or as Kohya does (lora_unet_<layer with _ for .>.lora_down.weight). The change is strength * alpha / rank *
B A: the rank is read from the matrices, alpha from the file's own tensors, its metadata, or peft's
adapter_config.json beside it; without any, alpha is the rank.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from dior_rt.errors import InputError

PREFIXES = ("base_model.model.", "model.diffusion_model.", "diffusion_model.", "transformer.")
KOHYA = "lora_unet_"
PART = re.compile(
    r"\.(?:(lora_A|lora_down|lora\.down)|(lora_B|lora_up|lora\.up))(?:\.\w+)?\.weight$|\.(alpha)$"
)


@dataclass
class _Change:
    """The keys of one layer's matrices in the file."""

    down: str = ""
    up: str = ""
    alpha: str = ""


class Lora:
    """A LoRA file and the strength with which it is merged."""

    def __init__(self, path: Path, strength: float = 1.0) -> None:
        """Open the file. Raises InputError if it is missing, cut short, or no LoRA."""
        if not math.isfinite(strength):
            raise InputError(f"The LoRA {path.name} cannot be merged with a strength of {strength}.")
        self.path, self.strength = path, strength
        try:
            with safe_open(path, framework="pt") as file:
                keys, self._metadata = list(file.keys()), _adapter(path, file.metadata() or {})
        except (OSError, SafetensorError) as error:
            raise InputError(f"{path} is missing, cut short, or no safetensors file: {error}.") from error
        self._changes: dict[str, _Change] = {}
        for key in keys:
            self._sort(key)
        for layer, change in self._changes.items():
            if not (change.down and change.up):
                raise InputError(f"The LoRA {path} has only one of the two matrices for {layer!r}.")
        if not self._changes:
            raise InputError(f"{path} holds no LoRA.")

    def targets(self, names: Iterable[str]) -> list[str]:
        """Return the model's tensors that the file changes, with Kohya's layer names translated.

        Raises InputError if the file changes layers that the model does not have.
        """
        layers = {name.removesuffix(".weight"): name for name in names if name.endswith(".weight")}
        flat = {KOHYA + layer.replace(".", "_"): layer for layer in layers}
        self._changes = {flat.get(layer, layer): change for layer, change in self._changes.items()}
        strange = [layer for layer in self._changes if layer not in layers]
        if strange:
            raise InputError(
                f"The LoRA {self.path} is for another model: {len(strange)} of its {len(self._changes)} "
                f"layers, such as {strange[0]!r}, are not in this one."
            )
        return [layers[layer] for layer in self._changes]

    def check(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raise InputError unless every change has the shape (out, in) of its layer."""
        with safe_open(self.path, framework="pt") as file:
            for layer, change in self._changes.items():
                down, up = (tuple(file.get_slice(key).get_shape()) for key in (change.down, change.up))
                if len(down) != 2 or len(up) != 2 or up[1] != down[0] or (up[0], down[1]) != shapes[layer]:
                    raise InputError(
                        f"The LoRA {self.path} does not fit this model: its change to {layer!r} is "
                        f"{up} x {down}, the layer {shapes[layer]}."
                    )

    def delta(self, layer: str) -> NDArray[np.float32] | None:
        """Return the change of the layer's (out, in) weight, or None."""
        change = self._changes.get(layer)
        if change is None:
            return None
        with safe_open(self.path, framework="pt") as file:
            down, up = file.get_tensor(change.down).float(), file.get_tensor(change.up).float()
            alpha = float(file.get_tensor(change.alpha)) if change.alpha else self._metadata.alpha(layer)
        rank = down.shape[0]
        scale = 1.0 if alpha is None else alpha / (math.sqrt(rank) if self._metadata.rslora else rank)
        delta = self.strength * scale * (up @ down)
        if not torch.isfinite(delta).all():
            raise InputError(f"The LoRA {self.path} is damaged: its change to {layer!r} is not finite.")
        return delta.numpy()

    def _sort(self, key: str) -> None:
        match = PART.search(key)
        if match is None:
            raise InputError(f"{self.path} is no LoRA that can be merged: it holds {key!r}.")
        layer = key[: match.start()]
        for prefix in PREFIXES:
            layer = layer.removeprefix(prefix)
        change = self._changes.setdefault(layer, _Change())
        role = "down" if match[1] else "up" if match[2] else "alpha"
        if getattr(change, role):
            raise InputError(f"The LoRA {self.path} changes {layer!r} twice.")
        setattr(change, role, key)


@dataclass(frozen=True)
class _Adapter:
    """The scale in peft's settings, used if the file's tensors do not contain it."""

    default: float | None = None
    patterns: Mapping[str, float] | None = None
    rslora: bool = False

    def alpha(self, layer: str) -> float | None:
        for pattern, alpha in (self.patterns or {}).items():
            if re.match(rf"(.*\.)?({pattern})$", layer):
                return alpha
        return self.default


def _adapter(path: Path, metadata: Mapping[str, str]) -> _Adapter:
    beside = path.with_name("adapter_config.json")
    try:
        if "lora_adapter_metadata" in metadata:
            found: dict[str, Any] = json.loads(metadata["lora_adapter_metadata"])
        elif beside.is_file():
            found = json.loads(beside.read_text(encoding="utf-8"))
        else:
            return _Adapter()
    except ValueError as error:
        raise InputError(f"The LoRA {path} has settings that cannot be read: {error}.") from error
    settings = {key.removeprefix("transformer."): value for key, value in found.items()}
    if settings.get("use_dora") or settings.get("lora_bias"):
        raise InputError(f"{path} is no plain LoRA (it uses DoRA or biases), and cannot be merged.")
    return _Adapter(
        settings.get("lora_alpha"), settings.get("alpha_pattern"), bool(settings.get("use_rslora"))
    )
