"""Read and write strokes and Lumi maps. The documentation calls these formats the ways to draw light.

    strokes.png    RGBA: where alpha > 0 light is specified, and the colour is that light, sRGB-encoded
    map.png        RGB (any picture): light is specified everywhere, or with key "black" wherever it is not
                   black
    map.exr        float RGB, linear light; with A: A > 0 is specified, and RGB is multiplied by A, as EXR
                   has it
    map.npy        float (H, W, 3) linear light, or (H, W, 4) with the mask 0..1 as the fourth channel
    strokes.json   strokes as lines: [stroke, ...] or {"size": [width, height], "strokes": [stroke, ...]}
    project.dior   the lights of a project of the light desk: see `dior_rt.project`

Light has the primaries that its file names (an ICC profile, an EXR's chromaticities), else those of sRGB,
and is converted to the photo's own in linear light.

A stroke in JSON is {"points": [[x, y], ...], "width": pixels} and, where wanted, "color": "#rrggbb" (sRGB) or
[r, g, b] (linear), "intensity": any number >= 0, "softness": 0..1, "blend": "set", "add" or "multiply", see
`dior_rt.lights`. Coordinates are pixels of "size", or else of the photo as it is seen; (0, 0) is the upper
left corner.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dior_rt import project
from dior_rt.errors import InputError
from dior_rt.files import check_readable, check_writable, reason, replacing
from dior_rt.images.arrays import check_same_shape, convert_raster, convert_strokes
from dior_rt.images.exr import read_exr_picture, write_exr
from dior_rt.images.metadata import DAMAGE
from dior_rt.images.photo import MOST_PIXELS, Photo, check_output, read_photo, write_photo
from dior_rt.images.primaries import Matrix, conversion, convert, srgb
from dior_rt.kernels import NumpyOps, Stroke, Strokes
from dior_rt.kernels.color import srgb_to_linear
from dior_rt.kernels.types import FARTHEST
from dior_rt.lights import BLENDS, Blend, Light, convert_lights
from dior_rt.records import read_json

Key = Literal["black"]

SAME_SHAPE = 0.1  # the largest difference between the logarithms of two shapes' aspect ratios
_MOST_JSON_BYTES = 16 << 20


@dataclass(frozen=True)
class DrawingFile:
    """The content of a drawing.

    strokes: as `Relighter.relight` takes them. notices: sentences about missing data.
    """

    strokes: NDArray | list[Stroke] | list[Light]
    notices: tuple[str, ...] = ()


def read_strokes(
    path: Path, photo_size: tuple[int, int], key: Key | None = None
) -> NDArray | list[Stroke] | list[Light]:
    """Return the strokes of `read_drawing`, over a photo with sRGB's primaries."""
    return read_drawing(path, photo_size, key).strokes


def read_drawing(
    path: Path,
    photo_size: tuple[int, int],
    key: Key | None = None,
    page: int = 0,
    primaries: Matrix | None = None,
) -> DrawingFile:
    """Read strokes from a file of any kind above, ready for `Relighter.relight`.

    photo_size: (height, width) of the photo. key: "black" reads pixels that are exactly black as unspecified.
    page: the index of the page in a file with several. primaries: the photo's primaries, None for sRGB's;
    light in other primaries is converted. A raster is returned as (H, W, 4): uint8 or uint16, sRGB-encoded,
    or float32, linear; the last channel is the mask. JSON is returned as strokes in the photo's pixels, or as
    lights where any of them blends; a project is returned as its lights. Raises InputError for a file that
    cannot be read or makes no sense.
    """
    target = srgb() if primaries is None else primaries
    if path.suffix.lower() == project.SUFFIX:
        lights = project.lights_of(project.read_project(path), photo_size)
        return DrawingFile(convert_lights(lights, conversion(srgb(), target)))
    if path.suffix.lower() == ".json":
        return DrawingFile(_read_json(path, photo_size, conversion(srgb(), target)))
    raster = _read_raster(path, "strokes", photo_size, page)
    pixels = raster.pixels
    if key == "black":
        if raster.lossy:
            raise InputError(
                f"Cannot read the strokes {path} with --key black: such a file blurs black, so that drawn "
                "darkness cannot be told from what was left open; save them as PNG."
            )
        pixels[..., 3] *= (pixels[..., :3] != 0).any(axis=-1)
    return DrawingFile(convert_raster(pixels, conversion(raster.primaries, target)), raster.notices)


def read_lumi(path: Path) -> NDArray[np.float32]:
    """Return a dense Lumi map (H, W, 3), linear float32 >= 0 in sRGB's primaries, from any raster above.

    Pictures are decoded from sRGB. Raises InputError, also for a map that leaves pixels unspecified.
    """
    raster = _read_raster(path, "Lumi map", None, 0)
    light, mask = raster.pixels[..., :3], raster.pixels[..., 3]
    if not mask.all():
        raise InputError(f"The Lumi map {path} leaves pixels unspecified; a Lumi map speaks of all of them.")
    if light.dtype != np.float32:
        light = NumpyOps().decode_srgb(light)
    return np.ascontiguousarray(convert(light, conversion(raster.primaries, srgb())))


def check_lumi_output(path: Path) -> None:
    """Raise InputError where `write_lumi` would fail, as far as that can be checked."""
    if path.suffix.lower() in (".npy", ".exr"):
        check_writable(path)
    else:
        check_output(path, Photo(np.zeros((1, 1, 3), np.uint8)))


def write_lumi(
    path: Path, lumi: NDArray[np.float32], settings: Mapping[str, Any], primaries: Matrix | None = None
) -> None:
    """Write a Lumi map (H, W, 3). A .npy or .exr keeps all of it; a picture is clipped to display white.

    primaries: those of the map, None for sRGB's. Every file is written with sRGB's.
    """
    lumi = lumi if primaries is None else convert(lumi, conversion(primaries, srgb()))
    if path.suffix.lower() == ".npy":
        _write_npy(path, lumi)
    elif path.suffix.lower() == ".exr":
        write_exr(path, lumi)
    else:
        write_photo(path, Photo(NumpyOps().encode_srgb(lumi, np.uint8)), settings, generated=False)


def check_strokes_output(path: Path) -> None:
    """Raise InputError where `write_strokes` would fail, as far as that can be checked."""
    if path.suffix.lower() not in (".png", ".npy", ".exr"):
        raise InputError(f"Cannot write {path}: the name of strokes must end in .png, .npy or .exr.")
    check_writable(path)


def write_strokes(path: Path, strokes: Strokes, settings: Mapping[str, Any]) -> None:
    """Write strokes. A .npy (H, W, 4) or .exr keeps all; an RGBA .png holds 8 bits, up to display white."""
    check_strokes_output(path)
    if path.suffix.lower() == ".npy":
        return _write_npy(path, np.dstack([strokes.light, strokes.mask]))
    if path.suffix.lower() == ".exr":
        mask = strokes.mask[..., None]
        drawn = np.where(mask > 0, strokes.light, np.float32(0)) * mask
        return write_exr(path, np.concatenate([drawn, mask], axis=-1))
    alpha = np.round(strokes.mask * 255).astype(np.uint8)
    picture = Photo(NumpyOps().encode_srgb(strokes.light, np.uint8), alpha)
    write_photo(path, picture, settings, generated=False)


@dataclass(frozen=True)
class Raster:
    """A raster of light.

    pixels: (H, W, 4) light and mask, see `read_drawing`. primaries: those of the light.
    """

    pixels: NDArray
    primaries: Matrix = field(default_factory=srgb)
    notices: tuple[str, ...] = ()
    lossy: bool = False


def _read_raster(path: Path, what: str, photo_size: tuple[int, int] | None, page: int) -> Raster:
    suffix = path.suffix.lower()
    if suffix not in (".npy", ".exr"):
        return _read_picture(path, what, photo_size, page)
    if page:
        raise InputError(f"Cannot read page {page} of the {what} {path}: it has one picture only.")
    notices: tuple[str, ...] = ()
    if suffix == ".npy":
        pixels, space = _read_npy(path, what), srgb()
    else:
        picture = read_exr_picture(path, what)
        (pixels, notices), space = _clean_exr(picture.pixels), picture.primaries
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    mask = pixels[..., 3]
    if not (mask.min() >= 0 and mask.max() <= 1):
        raise InputError(f"The mask of the {what} {path} must lie in 0..1.")
    drawn = pixels[mask > 0]
    if not (np.isfinite(drawn).all() and (drawn >= 0).all()):
        raise InputError(f"The light of the {what} {path} must be finite and not negative.")
    return Raster(pixels, space, notices)


def _clean_exr(pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Clean a picture of filters and renderers: clip alpha to 0..1 and negative light to 0, and count both.

    The light is returned divided by its alpha.
    """
    notices = []
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3]
        outside = int(((alpha < 0) | (alpha > 1)).sum())
        if outside:
            notices.append(f"Alpha outside 0..1 in {outside} pixels is brought to the nearer end.")
            np.clip(alpha, 0, 1, out=alpha)
        with np.errstate(over="ignore", invalid="ignore"):  # infinite results are refused
            np.divide(pixels[..., :3], pixels[..., 3:], out=pixels[..., :3], where=pixels[..., 3:] > 0)
    light = pixels[..., :3]
    negative = (light < 0).any(axis=-1)
    if pixels.shape[2] == 4:
        negative &= pixels[..., 3] > 0
    if count := int(negative.sum()):
        least = float(light[negative].min())
        notices.append(f"Negative light in {count} pixels, down to {least:.2g}, is read as none.")
        np.maximum(light, 0, out=light)
    return pixels, tuple(notices)


def _read_picture(path: Path, what: str, photo_size: tuple[int, int] | None, page: int) -> Raster:
    photo = read_photo(path, what, page)
    if photo.alpha is None:
        mask = np.full(photo.size, np.iinfo(photo.pixels.dtype).max, photo.pixels.dtype)
    elif photo.alpha.dtype != photo.pixels.dtype:
        mask = photo.alpha.astype(np.uint16) * np.uint16(257)
    else:
        mask = photo.alpha
    pixels, notices = np.dstack([photo.pixels, mask]), list(photo.notices)
    if photo.pages > 1:
        notices[0] += " --page N reads another, 0 is the first."
    canvas = photo.canvas or photo_size
    if canvas and (photo.offset != (0, 0) or photo.canvas not in (None, photo.size)):
        check_canvas(path, what, canvas)
        pixels = _place(pixels, photo.offset, canvas)
    return Raster(pixels, photo.primaries, tuple(notices), photo.lossy)


def check_canvas(path: Path, what: str, canvas: tuple[int, int]) -> None:
    """Raise InputError for a canvas that is empty or too large to be made."""
    if not 0 < canvas[0] * canvas[1] <= MOST_PIXELS:
        raise InputError(
            f"Cannot read the {what} {path}: its canvas is empty, or has more than "
            f"{MOST_PIXELS // 10**6} megapixels."
        )


def _place(pixels: NDArray, offset: tuple[int, int], canvas: tuple[int, int]) -> NDArray:
    """Place a cut-out picture on its canvas of (rows, columns). The pixels around it are unspecified."""
    placed = np.zeros((*canvas, pixels.shape[2]), pixels.dtype)
    (x, y), (height, width) = offset, pixels.shape[:2]
    top, left = max(y, 0), max(x, 0)
    bottom, right = min(y + height, canvas[0]), min(x + width, canvas[1])
    if top < bottom and left < right:
        placed[top:bottom, left:right] = pixels[top - y : bottom - y, left - x : right - x]
    return placed


def _read_npy(path: Path, what: str) -> NDArray[np.float32]:
    check_readable(path, what)
    try:
        # The file is memory-mapped, so that a header which promises more than the file holds takes no
        # memory.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            array.close()
            raise ValueError("it is an archive of arrays (.npz); save the one array as .npy")
        if array.ndim != 3 or array.shape[2] not in (3, 4) or array.size == 0:
            raise ValueError(f"it must be an array (rows, columns, 3 or 4), not {array.shape}")
        if array.dtype.kind != "f":
            raise ValueError(f"its light must be floating-point and linear, not {array.dtype}")
        if array.shape[0] * array.shape[1] > MOST_PIXELS:
            raise ValueError(f"it has more than {MOST_PIXELS // 10**6} megapixels")
        with np.errstate(over="ignore"):  # too large values become infinite and are refused
            return np.array(array, np.float32)
    except (*DAMAGE, MemoryError, TokenError, RecursionError) as error:
        raise InputError(f"Cannot read the {what} {path}: {reason(error)}.") from error


def _write_npy(path: Path, array: NDArray[np.float32]) -> None:
    with replacing(path) as file:
        np.save(file, array.astype(np.float32, copy=False), allow_pickle=False)


def _read_json(path: Path, photo_size: tuple[int, int], matrix: Matrix | None) -> list[Stroke] | list[Light]:
    """matrix: from sRGB's primaries to the photo's."""
    check_readable(path, "strokes")
    try:
        document = read_json(path, _MOST_JSON_BYTES)
        scale = (1.0, 1.0)
        if isinstance(document, dict):
            _check_keys(document, known={"size", "strokes"}, needed={"strokes"})
            scale = _scale(document["size"], photo_size) if "size" in document else scale
            document = document["strokes"]
        if not isinstance(document, list):
            raise ValueError("it must be a list of strokes")
        strokes, blends = [], []
        for i, item in enumerate(document, 1):
            try:
                strokes.append(_parse_stroke(item, scale))
                blends.append(_blend(item))
            except (ValueError, OverflowError) as error:
                raise ValueError(f"stroke {i}: {error}") from error
        strokes = convert_strokes(strokes, matrix)
        return _layers(strokes, blends) if set(blends) - {"set"} else strokes
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"Cannot read the strokes {path}: {reason(error)}.") from error


def _blend(item: dict[str, Any]) -> Blend:
    blend = item.get("blend", "set")
    if blend not in BLENDS:
        raise ValueError(f"blend must be one of {', '.join(BLENDS)}, not {blend!r:.40}")
    return blend


def _layers(strokes: list[Stroke], blends: list[Blend]) -> list[Light]:
    """Return layers: consecutive strokes with the same blend form one layer."""
    runs = groupby(zip(blends, strokes, strict=True), key=itemgetter(0))
    return [Light(tuple(stroke for _, stroke in run), blend) for blend, run in runs]


def _scale(size: Any, photo_size: tuple[int, int]) -> tuple[float, float]:
    """Return the photo's pixels per pixel of the drawing, across and down."""
    (columns, rows), (height, width) = _numbers(size, 2, "size"), photo_size
    if not (min(columns, rows) > 0 and max(columns, rows) <= FARTHEST):
        raise ValueError("size must be [width, height] in pixels")
    off = abs(math.log(columns / rows * height / width))
    # One pixel of a very small drawing is such a large share that any shape would pass.
    if off > SAME_SHAPE or not math.isfinite(off):
        raise ValueError(
            f"size is {columns:g} x {rows:g} and the photo is {width} x {height}: the shapes differ"
        )
    check_same_shape((max(1, round(rows)), max(1, round(columns))), photo_size)
    return width / columns, height / rows


def _parse_stroke(item: Any, scale: tuple[float, float]) -> Stroke:
    if not isinstance(item, dict):
        raise ValueError("it must be an object with points and a width")
    _check_keys(item, known={"points", "width", "blend", *_OPTIONAL}, needed={"points", "width"})
    if not isinstance(item["points"], list):
        raise ValueError("points must be a list of [x, y]")
    points = _points(item["points"])
    return Stroke(
        points=tuple((x * scale[0], y * scale[1]) for x, y in points),
        width=_number(item["width"], "width") * math.sqrt(scale[0] * scale[1]),
        **{name: parse(item[name], name) for name, parse in _OPTIONAL.items() if name in item},
    )


def _points(values: list[Any]) -> list[tuple[float, float]]:
    flat = list(chain.from_iterable(values)) if set(map(type, values)) <= {list} else []
    if flat and set(map(len, values)) == {2} and set(map(type, flat)) <= {int, float}:  # fast for many points
        numbers = list(map(float, flat))
        return list(zip(numbers[::2], numbers[1::2], strict=True))
    return [(x, y) for x, y in (_numbers(point, 2, "each point") for point in values)]


def _color(value: Any, what: str) -> tuple[float, ...]:
    """Return the linear RGB of "#rrggbb", which is sRGB, or of [r, g, b], which is already linear."""
    if not isinstance(value, str):
        return tuple(_numbers(value, 3, what))
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", value):
        raise ValueError(f"{what} must be #rrggbb or [r, g, b], not {value!r:.40}")
    codes = np.frombuffer(bytes.fromhex(value[1:]), np.uint8)
    return tuple(float(v) for v in srgb_to_linear(codes / 255))


def _numbers(value: Any, count: int, what: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{what} must be a list of {count} numbers")
    return [_number(item, what) for item in value]


def _number(value: Any, what: str) -> float:
    if type(value) not in (int, float):
        raise ValueError(f"{what} must be made of numbers, not {value!r:.40}")
    return float(value)


_OPTIONAL: dict[str, Callable[[Any, str], Any]] = {"color": _color, "intensity": _number, "softness": _number}


def _check_keys(document: dict[str, Any], known: set[str], needed: set[str]) -> None:
    if unknown := sorted(document.keys() - known):
        raise ValueError(f"the key {unknown[0]!r} is unknown; known are {', '.join(sorted(known))}")
    if missing := sorted(needed - document.keys()):
        raise ValueError(f"the key {missing[0]!r} is missing")
