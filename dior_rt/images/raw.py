"""Read camera raw by LibRaw (extra [raw]), developed to 16 bits in linear light at the camera's white
balance.

The photo has the primaries of ProPhoto RGB, which cover the gamut of sensors, and its profile. Nothing is
brightened or sharpened, so that drawn light adds to the light that the sensor counted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import rawpy

from dior_rt.images.icc import interpret
from dior_rt.images.photo import MOST_PIXELS, Photo
from dior_rt.images.primaries import gamma_tag, make_profile

#: ROMM RGB (ISO 22028-2): red, green, blue and white, x and y.
PROPHOTO: Final = (0.734699, 0.265301, 0.159597, 0.840403, 0.036598, 0.000105, 0.345704, 0.358540)
GAMMA: Final = 461 / 256  # ROMM RGB's 1.8, as a profile holds it
DEVELOPED: Final = "It is a camera raw file, developed without a tone curve in the camera's white balance."


def read(path: Path) -> Photo:
    """Develop a file. Raises ValueError for a damaged file, or for a camera that LibRaw does not support."""
    try:
        with rawpy.imread(str(path)) as raw:
            if not 0 < raw.sizes.width * raw.sizes.height <= MOST_PIXELS:
                raise ValueError(f"it is empty, or has more than {MOST_PIXELS // 10**6} megapixels")
            linear = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                use_camera_wb=True,
                output_bps=16,
                output_color=rawpy.ColorSpace.ProPhoto,
            )
    except rawpy.LibRawError as error:
        text = error.args[0] if error.args else error
        raise ValueError(text.decode() if isinstance(text, bytes) else str(text)) from error
    # Encode linear light by a curve that distributes the 16 bits as the eye perceives them.
    curved = np.round((np.arange(65536) / 65535) ** (1 / GAMMA) * 65535).astype(np.uint16)[linear]
    coloured = interpret(curved, make_profile(PROPHOTO, gamma_tag(GAMMA)))
    return Photo(coloured.pixels, None, coloured.curves, coloured.icc, notices=(DEVELOPED, *coloured.notices))
