"""The parts of a scene: objects, a panorama around them, candidate cameras, and the lamps that views add.

Everything is plain data in metres, z up. The description places a scene's objects; `cycles` builds it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dior_rt.training.blender.meshes import Mesh

Vector = NDArray[np.float64]
Role = Literal["shell", "subject", "thing"]
LampKind = Literal["point", "area", "spot", "sun"]
GoboKind = Literal["flag", "slats", "window", "leaves"]


@dataclass(frozen=True, eq=False)
class Thing:
    """A mesh in its place.

    role: "shell" is ground, walls and ceiling; "subject" is the main object of the picture. turn: about z, in
    radians, after `tilt` about x. scale: a factor on the mesh's size.
    """

    mesh: Mesh
    at: tuple[float, float, float]
    turn: float = 0.0
    scale: float = 1.0
    tilt: float = 0.0
    role: Role = "thing"

    def matrix(self) -> Vector:
        """Return the 4 x 4 matrix from the mesh's space to the scene's."""
        c, s, ct, st = (f(a) for a in (self.turn, self.tilt) for f in (math.cos, math.sin))
        about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
        placed = np.eye(4)
        placed[:3, :3] = about_z @ about_x * self.scale
        placed[:3, 3] = self.at
        return placed

    def corners(self) -> Vector:
        """Return (8, 3) the corners of the object's box."""
        low, size = self.mesh.low, self.mesh.size
        unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        matrix = self.matrix()
        return (low + unit * size) @ matrix[:3, :3].T + matrix[:3, 3]

    def holds(self, point: Vector, margin: float) -> bool:
        """Return whether a point lies in the object's box, or within `margin` of it."""
        matrix = self.matrix()
        local = np.linalg.solve(matrix[:3, :3], point - matrix[:3, 3])
        slack = margin / self.scale
        low, size = self.mesh.low, self.mesh.size
        return bool(np.all(local > low - slack) and np.all(local < low + size + slack))


@dataclass(frozen=True)
class Camera:
    """at, target: points. fov: of the square picture, in degrees. roll: in degrees."""

    at: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    roll: float = 0.0

    def axes(self) -> Vector:
        """Return (3, 3) rows: the camera's right, up and backward directions in the scene."""
        back = np.subtract(self.at, self.target).astype(float)
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        up = np.cross(back, right)
        c, s = math.cos(math.radians(self.roll)), math.sin(math.radians(self.roll))
        return np.stack([c * right + s * up, c * up - s * right, back])

    def rays(self, side: int) -> Vector:
        """Return (side * side, 3) unit directions through a grid of the picture, row by row from the top."""
        reach = math.tan(math.radians(self.fov / 2))
        steps = (np.arange(side) + 0.5) / side * 2 - 1
        x, y = np.meshgrid(steps * reach, -steps * reach)
        rays = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3) @ self.axes()
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@dataclass(frozen=True)
class Gobo:
    """A pattern before a lamp that lets light through in some directions.

    kind: "flag" half plane, "slats" a blind, "window" panes, "leaves" spots. size: of the pattern, as the
    tangent of an angle. turn: in radians. shift: of the pattern. soft: width of its edges, as a share of
    its size.
    """

    kind: GoboKind
    size: float
    turn: float
    shift: float
    soft: float


@dataclass(frozen=True)
class Lamp:
    """A white light of unit colour.

    size: radius or side in metres; for a sun the angle it spans in degrees. cone: the full angle of a spot in
    degrees. blend: softness of the cone's edge, 0 to 1. role: how it was placed, as "candle" or "rim".
    """

    kind: LampKind
    at: tuple[float, float, float]
    target: tuple[float, float, float]
    size: float
    role: str
    cone: float = 60.0
    blend: float = 0.3
    gobo: Gobo | None = None

    def direction(self) -> Vector:
        """Return the unit vector along which it shines."""
        along = np.subtract(self.target, self.at).astype(float)
        return along / np.linalg.norm(along)


@dataclass(frozen=True)
class Panorama:
    """An environment by name, turned about z by `turn` radians."""

    name: str
    turn: float


@dataclass(frozen=True, eq=False)
class BlenderScene:
    """Objects under a panorama.

    cameras: candidates, best first. span: size of the important part, in metres.
    """

    kind: str
    seed: int
    split: str
    things: tuple[Thing, ...]
    panorama: Panorama
    cameras: tuple[Camera, ...]
    span: float
    inside: tuple[Vector, Vector] | None = None  # the room's corners, which the lamps must stay within

    def free(self, point: Vector, margin: float = 0.03) -> bool:
        """Return whether a lamp fits at a point: in the room, above the ground, in no object's box."""
        if point[2] < 0.02 or (
            self.inside
            and (np.any(point < self.inside[0] + margin) or np.any(point > self.inside[1] - margin))
        ):
            return False
        return not any(thing.role != "shell" and thing.holds(point, margin) for thing in self.things)
