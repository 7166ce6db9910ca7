"""Read and write the files of a checkpoint, which training writes and export reads."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.training.network.config import Config
from dior_rt.training.network.model import Mini

#: File of the weights in a checkpoint's folder.
WEIGHTS: Final = "model.safetensors"
#: Folder of the LoRA in a checkpoint's folder.
LORA: Final = "lora"


def save_network(network: Mini, path: Path) -> None:
    """Write the weights as safetensors, with the configuration in the header.

    The file is written whole, or InputError is raised.
    """
    weights = {name: weight.contiguous() for name, weight in network.state_dict().items()}
    with replacing(path) as file:
        file.write(save(weights, {"config": json.dumps(asdict(network.config))}))


def load_network(path: Path) -> Mini:
    """Return the network in a file written by `save_network`. Half-precision weights become float32.

    Raises InputError for a file that is missing, cut short, or of another kind.
    """
    check_readable(path, "checkpoint")
    try:
        with safe_open(path, "pt") as file:
            network = Mini(Config(**json.loads((file.metadata() or {})["config"])))
        network.load_state_dict({name: weight.float() for name, weight in load_file(path).items()})
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} is no checkpoint of mini: {reason(error)}.") from error
    return network.eval()
