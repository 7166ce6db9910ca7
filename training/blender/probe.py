"""Find what a camera sees with a few hundred rays, to judge a picture's composition and to place lamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dior_rt.training.blender.scene import BlenderScene, Camera, Vector

SIDE = 20


@dataclass(frozen=True)
class Hits:
    """The hits of rays. hit: (N,) whether they hit. at, normal: (N, 3). thing: (N,) index, -1 for none."""

    hit: NDArray[np.bool_]
    at: Vector
    normal: Vector
    thing: NDArray[np.int64]


class Stage(Protocol):
    """A built scene that reports what rays hit."""

    def cast(self, origin: Vector, directions: Vector, reach: float = 1e6) -> Hits: ...


def look(stage: Stage, camera: Camera) -> Hits:
    """Return what the camera sees, on a grid of SIDE x SIDE rays. Normals face the camera."""
    rays = camera.rays(SIDE)
    hits = stage.cast(np.asarray(camera.at), rays)
    facing = np.sign(-(hits.normal * rays).sum(1, keepdims=True))
    return Hits(hits.hit, hits.at, hits.normal * np.where(facing == 0, 1, facing), hits.thing)


def score(scene: BlenderScene, camera: Camera, hits: Hits) -> float:
    """Return the score of a composition. Above 0 it is a picture worth taking, and more is better.

    A good picture meets these conditions: the subject fills 6 to 60 % of the frame and not only its rim; no
    single object of the shell fills it; nothing stands right before the lens; there is more than one depth
    and one orientation.
    """
    roles = np.array([thing.role for thing in scene.things])
    seen = roles[np.maximum(hits.thing, 0)]
    subject = hits.hit & (seen == "subject")
    shell = hits.hit & (seen == "shell")
    share = subject.mean()
    if not 0.05 < share < 0.7 or (~hits.hit).mean() > 0.6:
        return -1.0
    distance = np.linalg.norm(hits.at - np.asarray(camera.at), axis=1)
    close = hits.hit & (distance < 0.3 * np.median(distance[subject]))
    counts = np.bincount(hits.thing[shell], minlength=len(roles))
    flat = counts.max() / len(shell)
    if close.mean() > 0.2 or flat > 0.72:
        return -1.0
    rows, columns = np.divmod(np.flatnonzero(subject), SIDE)
    cropped = subject[:SIDE].mean()  # along the picture's upper edge
    off = max(abs(rows.mean() / SIDE - 0.5), abs(columns.mean() / SIDE - 0.5))
    others = len(np.unique(hits.thing[hits.hit & ~shell]))
    filled = 1 - 1.5 * abs(share - 0.25)
    value = filled + 0.08 * min(others, 5) - 1.2 * max(off - 0.15, 0) - max(flat - 0.45, 0) - 0.6 * cropped
    return float(max(value, 0.01))
