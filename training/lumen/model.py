"""Lumen: scene network and light network, and the checkpoint that holds both."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing
from dior_rt.training.lumen.completion import Completed, LightNetwork, Strokes
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.scene import Scene, SceneNetwork
from dior_rt.training.lumen.shading import log_ratio, relight


class Lumen(nn.Module):
    """photo -> scene (once a photo); scene and strokes -> completed light (every step of the flow) ->
    picture.
    """

    def __init__(self, config: LumenConfig) -> None:
        super().__init__()
        self.config = config
        self.scene = SceneNetwork(config)
        self.light = LightNetwork(config)

    def forward(
        self, x: Tensor, sigma: Tensor, photo: Tensor, strokes: Strokes
    ) -> tuple[Scene, Completed, Tensor]:
        """The scene, the completed light, and the relit picture, linear and not clipped."""
        scene = self.scene(photo)
        return scene, *self.answer(x, sigma, photo, scene, strokes)

    def answer(
        self, x: Tensor, sigma: Tensor, photo: Tensor, scene: Scene, strokes: Strokes
    ) -> tuple[Completed, Tensor]:
        """The completed light and the relit picture of a scene that is known."""
        completed = self.light(x, sigma, photo, scene, strokes)
        ratio = log_ratio(
            scene.light, completed.target / torch.exp(completed.factor), scene.bounce, completed.factor
        )
        return completed, relight(photo, ratio)


def save_lumen(network: Lumen, path: Path, half: bool = False) -> None:
    """Weights as safetensors, the configuration in its header; written whole, or InputError raised."""
    weights = {
        name: (weight.detach().cpu().half() if half else weight.detach().cpu()).contiguous()
        for name, weight in network.state_dict().items()
    }
    with replacing(path) as file:
        file.write(save(weights, {"config": json.dumps(asdict(network.config))}))


def load_lumen(path: Path) -> Lumen:
    """The network of a file that `save_lumen` wrote; half-precision weights become float32.

    Raises InputError for a file that is missing, cut short, or something else.
    """
    check_readable(path, "checkpoint")
    try:
        with safe_open(path, "pt") as file:
            network = Lumen(LumenConfig(**json.loads((file.metadata() or {})["config"])))
        network.load_state_dict({name: weight.float() for name, weight in load_file(path).items()})
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} is no checkpoint of lumen: {reason(error)}.") from error
    return network.eval()
