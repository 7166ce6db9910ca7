"""The encoding of a result: its quality, where the format offers one, and its bits per channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: The bits per channel that each format can hold.
BITS: Final = {
    "PNG": (8, 16),
    "TIFF": (8, 16),
    "JPEG": (8,),
    "WEBP": (8,),
    "JXL": (8, 16),
    "EXR": (16, 32),
}
LOSSY: Final = ("JPEG", "WEBP", "JXL")


@dataclass(frozen=True)
class Encoding:
    """How to encode a result.

    quality: 1 to 100, or None for the format's default (JPEG and WebP 95, JPEG XL exact). bits: bits per
    channel, or None to keep the photo's bits as far as the format holds them.
    """

    quality: int | None = None
    bits: int | None = None

    def problem(self, form: str) -> str | None:
        """Return why a format cannot be written with this encoding, as the end of a sentence, or None."""
        if self.bits is not None and self.bits not in BITS[form]:
            held = " or ".join(map(str, BITS[form]))
            return f"{form} holds {held} bits a channel, not {self.bits}"
        if self.quality is not None and form not in LOSSY:
            return f"{form} keeps every pixel and has no quality to choose"
        return None


PLAIN: Final = Encoding()
