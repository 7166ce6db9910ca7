"""Read and write pictures of 16 bits per channel, which Pillow holds in 8.

Pillow opens, checks and unpacks PNG and TIFF of any kind, but its colour modes keep one byte per sample. The
caller can choose the byte: read as big-endian, a sample gives its high byte; read as little-endian, its low
one. Two passes over the file give the whole sample, with every compression, predictor, tiling and interlacing
that Pillow supports. The packages that read such files directly (imagecodecs, OpenCV) weigh 25 to 60 MB and
write no profile, EXIF or text into a PNG.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable, Mapping
from typing import IO

import numpy as np
from numpy.typing import NDArray
from PIL import ImageFile, PngImagePlugin, TiffImagePlugin

from dior_rt.images.directories import HEADER, LONG, SHORT, Directory, Entry, entry, pack
from dior_rt.images.icc import Pixels

Deep = NDArray[np.uint16]

#: The zlib strategy for every file. Predicted rows of a photo seldom repeat, so searching for more than runs
#: of bytes costs time, and space too.
STRATEGY = zlib.Z_RLE

_ROWS = 64  # rows per strip; compressed one by one, so that a large picture needs no second copy


def is_deep(image: ImageFile.ImageFile) -> bool:
    """Return whether an opened, not yet decoded picture has interleaved grey or RGB samples of 16 bits."""
    if isinstance(image, TiffImagePlugin.TiffImageFile) and image.tag_v2.get(284) == 2:
        return False  # planar data: Pillow has separate unpackers for it
    return image.mode.startswith("I;16") or (image.mode in ("RGB", "RGBA") and ";16" in _rawmode(image))


def read_deep(open_image: Callable[[], ImageFile.ImageFile]) -> Deep:
    """Return (H, W, channels) uint16. Channels: 1 grey, 2 grey and alpha, 3 RGB, 4 RGB and alpha.

    open_image opens the same picture anew each time. Raises Pillow's errors for a damaged file.
    """
    image = open_image()
    rawmode = _rawmode(image)
    if image.mode.startswith("I;16"):
        samples = np.asarray(image).astype(np.uint16)[..., None]
        white_is_zero = isinstance(image, TiffImagePlugin.TiffImageFile) and image.tag_v2.get(262) == 0
        return ~samples if white_is_zero else samples
    if rawmode == "LA;16B":  # 32 bits per pixel, like RGBA's four bytes
        return _bytes_of(image, "RGBA").view(">u2").astype(np.uint16)
    # A premultiplied sample must not be divided byte by byte.
    layout = rawmode.partition(";")[0].upper()
    high, low = (_bytes_of(open_image(), f"{layout};16{end}").astype(np.uint16) for end in "BL")
    if rawmode[-1] == "L" or (rawmode[-1] == "N" and sys.byteorder == "little"):
        high, low = low, high
    samples = high << np.uint16(8) | low
    return _unpremultiplied(samples) if rawmode.startswith("RGBa") else samples


def write_png(file: IO[bytes], samples: Deep, info: PngImagePlugin.PngInfo) -> None:
    """Write a PNG of (H, W, 3 or 4) uint16 samples, with info's chunks ahead of the pixels."""
    height, width, channels = samples.shape
    file.write(b"\x89PNG\r\n\x1a\n")
    header = struct.pack(">2I5B", width, height, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    PngImagePlugin.putchunk(file, b"IHDR", header)
    for name, data, *_ in info.chunks:
        PngImagePlugin.putchunk(file, name, data)
    packer = zlib.compressobj(strategy=STRATEGY)
    above = np.zeros((1, width * channels * 2), np.uint8)
    for top in range(0, height, _ROWS):
        rows = samples[top : top + _ROWS].astype(">u2").view(np.uint8).reshape(-1, above.shape[1])
        filtered = rows - np.concatenate([above, rows[:-1]])  # filter 2, "up": subtract the byte above
        above = rows[-1:]
        PngImagePlugin.putchunk(file, b"IDAT", packer.compress(np.insert(filtered, 0, 2, axis=1).tobytes()))
    PngImagePlugin.putchunk(file, b"IDAT", packer.flush())
    PngImagePlugin.putchunk(file, b"IEND")


def write_tiff(
    file: IO[bytes], samples: Pixels, tags: Directory, children: Mapping[int, Mapping[int, Entry]]
) -> None:
    """Write a TIFF of (H, W, 3 or 4) uint8 or uint16 samples, deflated as differences, with further tags.

    children: directories by the tag that points at them.
    """
    height, width, channels = samples.shape
    strips = []
    for top in range(0, height, _ROWS):
        rows = samples[top : top + _ROWS].copy()
        rows[:, 1:] -= samples[top : top + _ROWS, :-1]
        packer = zlib.compressobj(strategy=STRATEGY)
        strips.append(packer.compress(rows.astype(rows.dtype.newbyteorder("<")).tobytes()) + packer.flush())
    lengths = [len(strip) for strip in strips]
    own = {
        256: entry(LONG, width),
        257: entry(LONG, height),
        258: entry(SHORT, *(8 * samples.itemsize,) * channels),
        259: entry(SHORT, 8),  # deflate
        262: entry(SHORT, 2),  # RGB
        277: entry(SHORT, channels),
        278: entry(LONG, _ROWS),
        279: entry(LONG, *lengths),
        317: entry(SHORT, 2),  # differences along the row
    }
    if channels == 4:
        own[338] = entry(SHORT, 2)  # the colours are not multiplied by alpha
    starts = [sum(lengths[:i]) for i in range(len(lengths))]
    for _ in range(2):  # the strips follow the directory; their offsets do not change its size
        own[273] = entry(LONG, *starts)
        head = HEADER + pack({**tags, **own}, children)
        head += bytes(len(head) % 2)
        starts = [len(head) + sum(lengths[:i]) for i in range(len(lengths))]
    file.write(head)
    file.writelines(strips)


def _rawmode(image: ImageFile.ImageFile) -> str:
    """Return the name of the unpacker that Pillow would use, such as "RGB;16B"."""
    args = image.tile[0].args if image.tile else None
    return str(args[0] if isinstance(args, tuple) else args)


def _bytes_of(image: ImageFile.ImageFile, rawmode: str) -> NDArray[np.uint8]:
    """Return the picture decoded by another unpacker with as many bits per pixel."""
    image.tile = [
        tile._replace(args=(rawmode, *tile.args[1:]) if isinstance(tile.args, tuple) else rawmode)
        for tile in image.tile
    ]
    return np.array(image)


def _unpremultiplied(samples: Deep) -> Deep:
    alpha = np.maximum(samples[..., 3:], 1)
    colour = np.minimum(samples[..., :3].astype(np.uint32) * 65535 // alpha, 65535).astype(np.uint16)
    return np.concatenate([colour, samples[..., 3:]], axis=-1)
