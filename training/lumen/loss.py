"""The training loss: errors of the scene maps, of the completed light, and of the relit picture."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from dior_rt.training.lumen.batches import Batch, Truth
from dior_rt.training.lumen.completion import Completed
from dior_rt.training.lumen.optics import log_light, luminance
from dior_rt.training.lumen.scene import Scene
from dior_rt.training.lumen.shading import shown
from dior_rt.training.lumen.strokes import SET

SCALES = 4  # of gradients, in cells


@dataclass(frozen=True)
class Weights:
    """The weight of each error."""

    light: float = 1.0  # of the photo's own light: its logarithm and the gradients of it
    chroma: float = 1.0  # of its colour, more
    normal: float = 0.5
    depth: float = 0.2
    sky: float = 0.2
    albedo: float = 0.5
    target: float = 1.0  # of the completed light
    flow: float = 2.0  # of the flow's data variable
    picture: float = 24.0  # of the relit picture, squared
    edges: float = 1.0  # of the relit picture's gradients


def loss(
    scene: Scene, completed: Completed, relit: Tensor, batch: Batch, weights: Weights = Weights()
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the sum of the weighted errors, and each error by name."""
    truth = batch.truth
    errors = scene_errors(scene, truth) | light_errors(completed, batch) | picture_errors(relit, truth)
    total = sum(
        (getattr(weights, name) * error for name, error in errors.items()),
        torch.zeros_like(relit[0, 0, 0, 0]),
    )
    return total, {name: error.detach() for name, error in errors.items()}


def scene_errors(scene: Scene, truth: Truth) -> dict[str, Tensor]:
    """Return the errors of the scene that is read from the photo."""
    ground = 1 - truth.sky
    seen = ground.mean().clamp_min(1e-3)
    error = log_light(scene.light) - log_light(truth.light)
    grey = luminance(error)
    depth = scene.depth - truth.depth
    level = (depth * ground).sum(dim=(2, 3), keepdim=True) / ground.sum(dim=(2, 3), keepdim=True).clamp_min(1)
    depth = (depth - level) * ground
    cosine = (scene.normal * truth.normal).sum(dim=1, keepdim=True)
    return {
        "light": error.abs().mean() + gradients(error),
        "chroma": (error - grey).abs().mean() + gradients(error - grey),
        "normal": ((1 - cosine) * ground).mean() / seen,
        "depth": depth.abs().mean() / seen + gradients(depth),
        "sky": F.binary_cross_entropy_with_logits(scene.sky, truth.sky),
        "albedo": (scene.albedo - truth.albedo).abs().mean() + gradients(scene.albedo - truth.albedo),
    }


def light_errors(completed: Completed, batch: Batch) -> dict[str, Tensor]:
    """Return the errors of the completed light, in the terms of each sample's blend mode."""
    mode = batch.strokes.blend[:, None, None, None]
    error = torch.where(
        mode == SET,
        log_light(completed.target) - log_light(batch.truth.target),
        3 * (completed.x0 - batch.truth.x0),
    )
    return {
        "target": error.abs().mean() + gradients(error),
        "flow": (completed.x0 - batch.truth.x0).square().mean(),
    }


def picture_errors(relit: Tensor, truth: Truth) -> dict[str, Tensor]:
    """Return the errors of the relit picture, sRGB-encoded. Both pictures contain the photo's noise."""
    error = shown(relit) - truth.relit
    return {
        "picture": error.square().mean(),
        "edges": error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean(),
    }


def gradients(error: Tensor) -> Tensor:
    """Return mean absolute differences between neighbours, at several scales."""
    total = torch.zeros_like(error[0, 0, 0, 0])
    for k in range(SCALES):
        total = total + error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
        if k + 1 < SCALES:
            error = F.avg_pool2d(error, 2)
    return total / 2
