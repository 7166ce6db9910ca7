"""Merge a LoRA into the weights it was trained on: W + (alpha / rank) B A."""

from __future__ import annotations

from pathlib import Path
from typing import Final, TypeVar, cast

import torch
from peft import PeftConfig, PeftModel, set_peft_model_state_dict
from safetensors import SafetensorError
from safetensors.torch import load_file

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason

Network = TypeVar("Network", bound=torch.nn.Module)

CONFIG: Final = "adapter_config.json"
WEIGHTS: Final = "adapter_model.safetensors"


def merge_lora(network: Network, folder: Path) -> Network:
    """Return the network merged with the peft adapter in `folder`.

    The folder holds adapter_config.json and adapter_model.safetensors. Raises InputError for an adapter
    that is missing, cut short, or made for another network.
    """
    for name in (CONFIG, WEIGHTS):  # peft would search the internet for missing files, and read pickles
        check_readable(folder / name, "LoRA")
    try:
        weights = load_file(folder / WEIGHTS)
        adapted = PeftModel(network, PeftConfig.from_pretrained(str(folder)))
        missing, unexpected = cast(tuple[list[str], list[str]], set_peft_model_state_dict(adapted, weights))
        strange = [*unexpected, *(key for key in missing if "lora_" in key)]
        if strange:
            raise ValueError(f"the network and the adapter differ in {strange[0]}")
        return cast(Network, adapted.merge_and_unload(safe_merge=True))
    except (OSError, SafetensorError, ValueError, RuntimeError, TypeError, KeyError) as error:
        raise InputError(f"The LoRA in {folder} cannot be merged: {reason(error)}.") from error
