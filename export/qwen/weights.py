"""Read weights one tensor at a time, so that memory never holds a whole model."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from dior_rt.errors import InputError
from dior_rt.export.qwen.lora import Lora

Array = NDArray[np.float32]

INDEX = ".safetensors.index.json"
# Prefixes in single-file checkpoints and newer versions of transformers -> those in diffusers' folders.
RENAMED = (
    ("model.diffusion_model.", ""),
    ("diffusion_model.", ""),
    ("model.language_model.", "model."),
    ("model.visual.", "visual."),
)
READABLE = (torch.float32, torch.float16, torch.bfloat16)


class Weights(Protocol):
    """Named float32 tensors."""

    def shape(self, name: str) -> tuple[int, ...]: ...

    def __getitem__(self, name: str) -> Array: ...


def plain_names(keys: Iterable[str]) -> dict[str, str]:
    """Return keys -> names as in diffusers' folders."""
    return {key: _plain(key) for key in keys}


class Checkpoint:
    """The tensors of a safetensors file, or of a folder of them with diffusers' or transformers' index."""

    def __init__(self, path: Path, names: Callable[[Iterable[str]], dict[str, str]] = plain_names) -> None:
        """Open the checkpoint. names: the files' keys -> the tensors' names.

        Raises InputError if there are no weights at `path`, or if shards are missing or cut short.
        """
        self.path = path
        self._places = {
            name: (file, key) for file in _shards(path) for key, name in names(_keys(file)).items()
        }

    @property
    def names(self) -> Iterable[str]:
        return self._places.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        file, key = self._place(name)
        with safe_open(file, framework="pt") as tensors:
            return tuple(tensors.get_slice(key).get_shape())

    def __getitem__(self, name: str) -> Array:
        return self._read(name, lambda tensors, key: tensors.get_tensor(key))

    def rows(self, name: str, indices: Sequence[int]) -> Array:
        """Read some rows of a tensor."""
        return self._read(
            name, lambda tensors, key: torch.stack([tensors.get_slice(key)[i] for i in indices])
        )

    def _read(self, name: str, read: Callable[[Any, str], torch.Tensor]) -> Array:
        file, key = self._place(name)
        try:
            with safe_open(file, framework="pt") as tensors:
                tensor = read(tensors, key)
        except (OSError, SafetensorError) as error:
            raise InputError(f"Cannot read {key!r} from {file}: {error}.") from error
        if tensor.dtype not in READABLE:
            raise InputError(
                f"{file} stores {key!r} as {tensor.dtype}; export needs float32, float16 or bfloat16."
            )
        if not torch.isfinite(tensor).all():
            raise InputError(f"{file} is damaged: {key!r} contains values that are not finite.")
        return tensor.float().numpy()

    def _place(self, name: str) -> tuple[Path, str]:
        if name not in self._places:
            raise InputError(
                f"{self.path} has no tensor {name!r}; is it the model that its config describes?"
            )
        return self._places[name]


class Merged:
    """A checkpoint with merged LoRAs: W + sum of strength * alpha / rank * B A, tensor by tensor.

    Raises InputError for a LoRA of layers that the checkpoint does not have, or of another width.
    """

    def __init__(self, base: Checkpoint, loras: Sequence[Lora]) -> None:
        self._base, self._loras = base, loras
        for lora in loras:
            lora.check({name.removesuffix(".weight"): base.shape(name) for name in lora.targets(base.names)})

    def shape(self, name: str) -> tuple[int, ...]:
        return self._base.shape(name)

    def __getitem__(self, name: str) -> Array:
        weight = self._base[name]
        for lora in self._loras:
            delta = lora.delta(name.removesuffix(".weight"))
            if delta is not None and name.endswith(".weight"):
                weight = weight + delta
        return weight


def read_config(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file. Raises InputError if there is none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read {path}: {error}.") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} holds no settings.")
    return document


def _shards(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.exists():
        raise InputError(f"There are no weights at {path}.")
    indices = sorted(path.glob(f"*{INDEX}"))
    if indices:
        places = read_config(indices[0]).get("weight_map")
        names = sorted(set(places.values())) if isinstance(places, dict) else []
        missing = [name for name in names if not (path / name).is_file()]
        if missing:
            raise InputError(f"{path} lacks {len(missing)} of its {len(names)} shards, such as {missing[0]}.")
        return [path / name for name in names]
    files = sorted(path.glob("*.safetensors"))
    if len(files) != 1:
        raise InputError(
            f"{path} should hold one safetensors file or an index of several; it holds {len(files)}."
        )
    return files


def _keys(file: Path) -> list[str]:
    try:
        with safe_open(file, framework="pt") as tensors:
            return list(tensors.keys())
    except (OSError, SafetensorError) as error:
        raise InputError(f"{file} is cut short or is no safetensors file: {error}.") from error


def _plain(key: str) -> str:
    for old, new in RENAMED:
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key
