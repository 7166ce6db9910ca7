"""Read PGM and PPM of more than 8 bits; Pillow keeps only 8. https://netpbm.sourceforge.net/doc/ppm.html"""

from __future__ import annotations

import re
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_HEADER = re.compile(rb"P([2356])(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)\s")


def is_deep_netpbm(head: bytes) -> bool:
    """Return whether a file that begins like this is a PGM or PPM with samples above 255."""
    found = _HEADER.match(head)
    return found is not None and int(found[4]) > 255


def read_netpbm(file: IO[bytes]) -> NDArray[np.uint16]:
    """Return (H, W, 1 or 3) samples, scaled to 0..65535 where the file's white differs. Raises ValueError."""
    file.seek(0)
    data = file.read()
    found = _HEADER.match(data)
    if found is None:
        raise ValueError("its header is damaged")
    kind, width, height, top = (int(found[i]) for i in range(1, 5))
    if not (width and height and 255 < top < 65536):
        raise ValueError("its header is damaged")
    channels = 3 if kind in (3, 6) else 1
    count, body = width * height * channels, data[found.end() :]
    samples: NDArray[Any]
    if kind in (2, 3):
        words = re.sub(rb"#[^\n]*", b"", body).split()[:count]
        samples = np.array([int(word) for word in words], np.int64)
    else:
        samples = np.frombuffer(body[: count * 2], ">u2") if len(body) >= count * 2 else np.empty(0)
    if samples.size < count:
        raise ValueError("it is cut short")
    if samples.max() > top or samples.min() < 0:
        raise ValueError("a sample lies above its white")
    if top != 65535:
        samples = np.round(samples.astype(np.float64) * (65535 / top))
    return samples.astype(np.uint16).reshape(height, width, channels)
