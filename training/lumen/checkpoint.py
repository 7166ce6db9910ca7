"""Read and write checkpoints: one file for a network, or a folder of small files for a run.

A folder holds the weights' average (float16), the state that the optimiser needs to resume, and the index
state.json, each in files of at most PART bytes, so that they can be moved one by one. The average alone is a
network.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.model import Lumen

INDEX: Final = "state.json"
AVERAGE: Final = "average"
STATE: Final = "state"
PART: Final = 15_000_000  # bytes per file


def save_lumen(network: Lumen, path: Path, half: bool = False) -> None:
    """Write weights as safetensors, with the configuration in the header, whole or not at all.

    Raises InputError.
    """
    weights = {
        name: (weight.detach().cpu().half() if half else weight.detach().cpu()).contiguous()
        for name, weight in network.state_dict().items()
    }
    with replacing(path) as file:
        file.write(save(weights, {"config": json.dumps(asdict(network.config))}))


def load_lumen(path: Path) -> Lumen:
    """Return the network in a file that `save_lumen` wrote, or in the folder of a training run (its average).

    Half-precision weights become float32. Raises InputError for a checkpoint that is missing or damaged.
    """
    try:
        if path.is_dir():
            network = Lumen(LumenConfig(**json.loads((path / INDEX).read_text())["config"]))
            network.load_state_dict(
                {name: weight.float() for name, weight in read_parts(path, AVERAGE).items()}
            )
            return network.eval()
        check_readable(path, "checkpoint")
        with safe_open(path, "pt") as file:
            network = Lumen(LumenConfig(**json.loads((file.metadata() or {})["config"])))
        network.load_state_dict({name: weight.float() for name, weight in load_file(path).items()})
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} is no checkpoint of lumen: {reason(error)}.") from error
    return network.eval()


def write_parts(folder: Path, name: str, tensors: dict[str, Tensor]) -> None:
    """Write tensors as `name-00.safetensors` and so on, each of at most PART bytes."""
    part: dict[str, Tensor] = {}
    size = number = 0
    for key, tensor in tensors.items():
        here = tensor.numel() * tensor.element_size()
        if part and size + here > PART - 100_000:
            _write(folder / f"{name}-{number:02d}.safetensors", part)
            part, size, number = {}, 0, number + 1
        part[key] = tensor.detach().cpu().contiguous()
        size += here
    _write(folder / f"{name}-{number:02d}.safetensors", part)


def _write(path: Path, tensors: dict[str, Tensor]) -> None:
    with replacing(path) as file:
        file.write(save(tensors))


def read_parts(folder: Path, name: str) -> dict[str, Tensor]:
    """Read what `write_parts` wrote."""
    tensors: dict[str, Tensor] = {}
    for path in sorted(folder.glob(f"{name}-*.safetensors")):
        tensors |= load_file(path)
    return tensors
