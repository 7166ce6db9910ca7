"""The interface of a model in training, and its implementation by mini with a LoRA."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

import torch
from peft import LoraConfig, PeftModel, get_peft_model
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.training.light import decode_lumi
from dior_rt.training.network import LORA, WEIGHTS, load_network, save_network

LORA_TARGETS: Final = ["qkv", "proj", "up", "down", "modulation", "unembed"]


class Backbone(Protocol):
    """A model in training."""

    @property
    def network(self) -> nn.Module:
        """Return the function that maps x, sigma, photo, light, mask and mode to the velocity of x."""

    def prepare(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Convert a batch of triplets (see `triplets.example`), its x0 and inputs to the network's
        variables.
        """

    def lumi(self, x0: Tensor, grid: tuple[int, int]) -> Tensor:
        """Return the Lumi maps for an x0 of estimate mode, (B, 3, h, w) of the grid, linear >= 0."""

    def save(self, network: nn.Module) -> None:
        """Write the network as it is exported later. It then holds the weights' average."""


class MiniLora:
    """The network at `base` with a LoRA; the folder `out` receives the base's weights and `lora/`."""

    def __init__(self, base: Path, rank: int, out: Path) -> None:
        """Load the network. Raises InputError for a base that is not a checkpoint of mini."""
        self.base, self.out = base, out
        lora = LoraConfig(r=rank, lora_alpha=rank, target_modules=LORA_TARGETS)
        self.network: nn.Module = get_peft_model(load_network(base), lora)  # type: ignore[arg-type]

    def prepare(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return batch

    def lumi(self, x0: Tensor, grid: tuple[int, int]) -> Tensor:
        return resample(decode_lumi((x0 + 1) / 2), grid)

    def save(self, network: nn.Module) -> None:
        assert isinstance(network, PeftModel)
        save_network(load_network(self.base), self.out / WEIGHTS)
        network.save_pretrained(str(self.out / LORA), safe_serialization=True)


def resample(light: Tensor, grid: tuple[int, int]) -> Tensor:
    """Resample (B, 3, h, w) >= 0 to another grid, where each cell is the mean of the area that it covers."""
    if light.shape[2:] == torch.Size(grid):
        return light
    return F.interpolate(light.float(), grid, mode="bilinear", antialias=True).clamp_min(0)
