"""The model families: how each turns a photo and strokes into network inputs, and outputs into light."""

from __future__ import annotations

from typing import Literal, Protocol, TypeVar

from dior_rt.flow.sampler import Array, Velocity
from dior_rt.kernels import Strokes

Mode = Literal["relight", "estimate"]
C = TypeVar("C")


class Family(Protocol[C]):
    """A bundle of one family, loaded on a device and safe to use from several threads. C is its condition.

    device, reason: what runs the networks, and why.
    """

    device: str
    reason: str

    def raster(self, height: int, width: int) -> tuple[int, int]:
        """The (rows, columns) on which light is predicted for a photo of height x width pixels."""

    def encode(self, photo: Array, strokes: Strokes | None, mode: Mode) -> C:
        """What the network sees of a photo (h, w, 3), sRGB 0..1, and of strokes of the same raster."""

    def noise_shape(self, condition: C) -> tuple[int, ...]:
        """The shape of the flow's state."""

    def sigmas(self, steps: int, condition: C) -> Array:
        """The flow times of the bundle's schedule: steps + 1 values, falling from 1 to 0."""

    def velocity(self, condition: C, sigmas: Array, guidance: float) -> Velocity:
        """The guided velocity at those flow times. Guidance 1 is the condition alone, 0 no strokes at all."""

    def decode_relit(self, x0: Array, condition: C) -> Array:
        """The relit raster (h, w, 3), sRGB-encoded 0..1."""

    def decode_lumi(self, x0: Array, condition: C) -> Array:
        """The estimated Lumi map of the raster (h, w, 3), linear >= 0."""
