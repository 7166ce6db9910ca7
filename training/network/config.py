"""The size of the network, and the numbers of its input and output channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from dior_rt.errors import InputError

RGB: Final = 3
MASK: Final = 1
#: Log-ratio of the drawn light to the light of white paper, and the mask.
STROKES: Final = RGB + MASK
#: Photo, encoded light, then the strokes themselves, spread around each cell, and over the whole picture.
SEEN: Final = RGB + RGB + 3 * STROKES
#: Correction of the log-ratio, correction of the source Lumi map, and one gate for each spread of the
#: strokes.
GATES: Final = 3
ANSWER: Final = RGB + RGB + GATES
#: Number of vectors by which a block is modulated: shift, scale and gate of attention, then of the MLP.
MODULATIONS: Final = 6
#: Relight and estimate.
MODES: Final = 2


@dataclass(frozen=True)
class Config:
    """The network's size. Raises InputError for sizes that do not fit together."""

    #: Width of a token; a multiple of 4 heads.
    width: int = 256
    #: Number of transformer blocks.
    depth: int = 8
    #: Attention heads of a block.
    heads: int = 8
    #: Side of a token in cells; a multiple of 4.
    patch: int = 8
    #: Features of a cell.
    fine: int = 16
    #: Features of 2 x 2 cells.
    half: int = 64
    #: Features of 4 x 4 cells.
    quarter: int = 128

    def __post_init__(self) -> None:
        if self.width % (4 * self.heads):
            raise InputError(f"The width must be a multiple of 4 times the heads; {self.width} is none.")
        if self.patch % 4:
            raise InputError(f"The patch must be a multiple of 4; {self.patch} is none.")
