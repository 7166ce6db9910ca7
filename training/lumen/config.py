"""The sizes of the network."""

from __future__ import annotations

from dataclasses import dataclass

from dior_rt.errors import InputError

PATCH = 8  # side of a token, in cells
SIDE = 128  # root of a grid's number of cells: the side that distances in cells refer to


@dataclass(frozen=True)
class LumenConfig:
    """Sizes of the network.

    width: channels of a token.
    heads: attention heads; they divide the width into multiples of 4.
    scene_depth: transformer blocks that read the photo.
    light_depth: transformer blocks that complete the light.
    fine, half, quarter: channels at strides 1, 2 and 4.
    colours: light colours that a photo's light may be mixed from.

    Raises InputError for a width that the heads do not divide into multiples of 4.
    """

    width: int = 320
    heads: int = 5
    scene_depth: int = 6
    light_depth: int = 6
    fine: int = 32
    half: int = 64
    quarter: int = 128
    colours: int = 4

    def __post_init__(self) -> None:
        if self.width % (4 * self.heads):
            raise InputError(f"The width must be a multiple of 4 times the heads; {self.width} is not.")
