"""Write lights as layers for other programs: OpenRaster for Krita and GIMP, EXR, and a zip of PNGs.

Each light becomes an RGBA layer of the photo's size: its colour is the drawn light times strength and tint,
and its alpha is the coverage. EXR keeps any strength, premultiplied as EXR requires. PNG and OpenRaster clip
at display white.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.arrays import to_8_bits
from dior_rt.images.photo import Photo
from dior_rt.kernels import NumpyOps, Strokes
from dior_rt.lights import Light

LAYER_FORMATS: Final = {
    "ora": "image/openraster",
    "exr": "image/x-exr",
    "png": "application/zip",
}

#: OpenRaster's names of the blend modes. A light with blend "set" lies over the photo.
_COMPOSITES: Final = {"set": "svg:src-over", "add": "svg:plus", "multiply": "svg:multiply"}
_THUMBNAIL: Final = 256  # pixels per side, by the OpenRaster specification


def write_layers(photo: Photo, lights: Sequence[Light], kind: str, folder: Path) -> bytes:
    """Write the lights in one file of a LAYER_FORMATS kind, the first at the bottom.

    Raises InputError for no lights.
    """
    if not lights:
        raise InputError("There is no light to export.")
    if kind == "exr":
        return _exr(photo, lights, folder)
    pictures = [_png(_rgba(light, photo.size)) for light in lights]
    return _ora(photo, lights, pictures) if kind == "ora" else _zip(lights, pictures)


def _raster(light: Light, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return (H, W, 4): linear light times strength and tint, and coverage, at the photo's size."""
    assert isinstance(light.drawn, Strokes)
    factor = np.float32(light.strength) * np.asarray(light.tint, np.float32)
    planes = np.dstack([light.drawn.light * factor, light.drawn.mask])
    resized = [
        Image.fromarray(planes[..., i]).resize(size[::-1], Image.Resampling.BILINEAR) for i in range(4)
    ]
    return np.dstack([np.asarray(plane) for plane in resized])


def _rgba(light: Light, size: tuple[int, int]) -> NDArray[np.uint8]:
    raster = _raster(light, size)
    color = NumpyOps().encode_srgb(np.ascontiguousarray(raster[..., :3]), np.uint8)
    return np.dstack([color, np.round(np.clip(raster[..., 3], 0, 1) * 255).astype(np.uint8)])


def _ora(photo: Photo, lights: Sequence[Light], pictures: Sequence[bytes]) -> bytes:
    pixels = to_8_bits(photo.pixels)
    height, width = photo.size
    names = [f"data/light{i}.png" for i in range(len(lights))]
    stack = "\n".join(
        f"    <layer name={quoteattr(light.name or 'Light')} src={quoteattr(name)} x='0' y='0' opacity='1.0' "
        f"visibility='{'visible' if light.on else 'hidden'}' composite-op='{_COMPOSITES[light.blend]}'/>"
        for light, name in reversed(list(zip(lights, names, strict=True)))
    )
    xml = (
        "<?xml version='1.0' encoding='UTF-8'?>\n"
        f"<image version='0.0.3' w='{width}' h='{height}'>\n  <stack>\n{stack}\n"
        "    <layer name='Photo' src='data/photo.png' x='0' y='0'/>\n  </stack>\n</image>\n"
    )
    thumbnail = Image.fromarray(pixels)
    thumbnail.thumbnail((_THUMBNAIL, _THUMBNAIL))
    return _archive(
        {
            "mimetype": b"image/openraster",  # first and stored, to be readable without unzipping
            "stack.xml": xml.encode(),
            "data/photo.png": _png(pixels),
            **dict(zip(names, pictures, strict=True)),
            "mergedimage.png": _png(pixels),
            "Thumbnails/thumbnail.png": _png(np.asarray(thumbnail)),
        }
    )


def _zip(lights: Sequence[Light], pictures: Sequence[bytes]) -> bytes:
    names = [f"{i + 1:02}-{_plain(light.name)}-{light.blend}.png" for i, light in enumerate(lights)]
    return _archive(dict(zip(names, pictures, strict=True)))


def _exr(photo: Photo, lights: Sequence[Light], folder: Path) -> bytes:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {}
    for i, light in enumerate(lights):
        raster = _raster(light, photo.size)
        raster[..., :3] *= raster[..., 3:]
        for plane, channel in enumerate("RGBA"):
            name = f"{i + 1:02}_{_plain(light.name)}_{light.blend}.{channel}"
            channels[name] = np.ascontiguousarray(raster[..., plane])
    path = folder / f"layers-{id(lights)}.exr"
    try:
        OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()
    finally:
        path.unlink(missing_ok=True)


def _plain(name: str) -> str:
    """Return a name without characters that file systems and channel names cannot hold."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower()[:40] or "light"


def _png(pixels: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", compress_level=3)
    return file.getvalue()


def _archive(contents: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:  # PNG is already compressed
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), data)
    return file.getvalue()
