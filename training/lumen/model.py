"""Lumen: the scene network, the light network, and the picture that results."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dior_rt.training.lumen.completion import Completed, LightNetwork, Strokes
from dior_rt.training.lumen.config import LumenConfig
from dior_rt.training.lumen.scene import Scene, SceneNetwork
from dior_rt.training.lumen.shading import log_ratio, relight


class Lumen(nn.Module):
    """The whole network.

    photo -> scene (once per photo)
    scene and strokes -> completed light (every step of the flow) -> picture
    """

    def __init__(self, config: LumenConfig) -> None:
        super().__init__()
        self.config = config
        self.scene = SceneNetwork(config)
        self.light = LightNetwork(config)

    def forward(
        self, x: Tensor, sigma: Tensor, photo: Tensor, strokes: Strokes
    ) -> tuple[Scene, Completed, Tensor]:
        """Return the scene, the completed light, and the relit picture, linear and not clipped."""
        scene = self.scene(photo)
        return scene, *self.answer(x, sigma, photo, scene, strokes)

    def answer(
        self, x: Tensor, sigma: Tensor, photo: Tensor, scene: Scene, strokes: Strokes
    ) -> tuple[Completed, Tensor]:
        """Return the completed light and the relit picture of a scene from an earlier call."""
        completed = self.light(x, sigma, photo, scene, strokes)
        ratio = log_ratio(
            scene.light, completed.target / torch.exp(completed.factor), scene.bounce, completed.factor
        )
        return completed, relight(photo, ratio)
